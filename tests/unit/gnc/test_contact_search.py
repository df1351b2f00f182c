"""A body that does not come on moves by a wave until it can push, and goes over without a jump."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import onnxruntime
import pytest

from snakesim.training.form import PolicyArrays
from snakesim_gnc.control.obstacle_aided import ObstacleAided, ObstacleAidedParameters
from snakesim_gnc.control.obstacle_aided.force_feedback_wave import ForceFeedbackWave
from snakesim_gnc.control.policy import POLICY_FOLDER
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.controller import ControllerCommand
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_testing.gnc.stage import ObservationStage, make_contact, make_stage

TAIL_S_M = 0.3
SEARCHES = "in search of contacts"
JUMP_RAD = 0.08  # of a target from one tick to the next; the waves themselves make 0.03


def searching(
    *, among_pegs: bool = False, **parameters: float
) -> tuple[ObservationStage, ObstacleAided]:
    """A body on its path that searches for contacts after a second, unless configured otherwise."""
    stage = make_stage()
    stage.pegs = stage.pegs if among_pegs else []
    defaults = ObstacleAidedParameters(search_after_s=1.0)
    return stage, ObstacleAided(stage.robot, msgspec.structs.replace(defaults, **parameters))


def stands(
    controller: ObstacleAided, stage: ObservationStage, ticks: range
) -> list[ControllerCommand]:
    """What is commanded while the body stays where it is."""
    return [controller.update(stage.make_observation(tick, TAIL_S_M)) for tick in ticks]


def targets(commands: list[ControllerCommand]) -> np.ndarray:
    return np.array([command.setpoints.target for command in commands])


FORWARD_WAVE_S = pytest.approx(0.8, rel=0.05)  # periods
FEEDBACK_WAVE_S = pytest.approx(math.tau / 5.39, rel=0.15)


def period_s(commands: list[ControllerCommand]) -> float:
    """Period of the sine that fits the targets of the head best."""
    head = targets(commands)[:, -1]
    times_s = 0.01 * np.arange(len(head))
    periods_s = np.arange(0.4, 4.0, 0.02)
    errors: list[float] = []
    for period in periods_s:
        phase_rad = math.tau * times_s / period
        basis = np.column_stack([np.sin(phase_rad), np.cos(phase_rad), np.ones_like(phase_rad)])
        fitted = basis @ np.linalg.lstsq(basis, head, rcond=None)[0]
        errors.append(float(np.sum((head - fitted) ** 2)))
    return float(periods_s[int(np.argmin(errors))])


def test_contact_search_of_standing_body_ends_with_path_retried() -> None:
    stage, controller = searching(search_after_s=1.2, search_s=2.0, shape_nm_per_rad=0.0)
    alone = stands(controller, stage, range(300))
    searches = [SEARCHES in command.telemetry.reason for command in alone]
    assert not any(searches[:115])
    assert all(searches[125:])
    assert np.ptp(targets(alone[125:])[:, -1]) > 0.5  # of the head
    stage.pegs = make_stage().pegs
    beside = stands(controller, stage, range(300, 400))
    assert not any(SEARCHES in command.telemetry.reason for command in beside[25:])
    assert max(command.telemetry.propulsion_n or 0.0 for command in beside) > 5.0
    assert np.abs(np.diff(targets(alone + beside), axis=0)).max() < JUMP_RAD
    again = stands(controller, stage, range(400, 480))
    assert SEARCHES in again[-1].telemetry.reason


@pytest.mark.parametrize("among_pegs", [True, False])
def test_contact_search_fruitless_wave_is_replaced_by_the_other(among_pegs: bool) -> None:
    stage, controller = searching(among_pegs=among_pegs, shape_nm_per_rad=0.0)
    seen = stands(controller, stage, range(1010))
    periods = [period_s(seen[first : first + 240]) for first in (150, 450, 750)]
    first, second = FORWARD_WAVE_S, FEEDBACK_WAVE_S
    if among_pegs:
        first, second = second, first
    assert periods == [first, second, first]
    assert np.abs(np.diff(targets(seen), axis=0)).max() < JUMP_RAD


@pytest.mark.slow
def test_contact_search_wave_starts_slow_and_continues_fast() -> None:
    stage, controller = searching(among_pegs=True, shape_nm_per_rad=0.0)
    for tick in range(100):
        controller.update(stage.make_observation(tick, TAIL_S_M - 0.15 + 0.0015 * tick))
    seen = stands(controller, stage, range(100, 1150))
    slow, fast = (
        pytest.approx(2 * math.tau / 5.39, rel=0.15),
        pytest.approx(math.tau / 5.39, rel=0.15),
    )
    assert [period_s(seen[first : first + 240]) for first in (150, 750)] == [slow, fast]
    assert np.abs(np.diff(targets(seen), axis=0)).max() < JUMP_RAD


def test_a_wave_that_leads_to_the_goal_goes_on() -> None:
    stage, controller = searching()
    stands(controller, stage, range(110))
    led = [
        controller.update(stage.make_observation(tick, TAIL_S_M + 0.0003 * (tick - 110)))
        for tick in range(110, 900)
    ]
    assert all(SEARCHES in command.telemetry.reason for command in led)
    assert [period_s(led[first : first + 240]) for first in (60, 300, 540)] == [FORWARD_WAVE_S] * 3


def test_contact_search_detects_standing_body_despite_pose_noise() -> None:
    (stage, controller), noise = searching(search_after_s=1.2), np.random.default_rng(1)
    observations = (
        stage.make_observation(tick, TAIL_S_M + noise.normal(0.0, 0.005)) for tick in range(300)
    )
    assert any(
        SEARCHES in controller.update(observation).telemetry.reason for observation in observations
    )


def test_contact_search_can_be_disabled() -> None:
    stage, never = searching(search_after_s=0.0)
    assert not any(
        SEARCHES in command.telemetry.reason for command in stands(never, stage, range(500))
    )


def test_the_wave_is_that_of_the_shipped_policy() -> None:
    stage, passed_s, draw = make_stage(), 2.3, np.random.default_rng(3)
    observation = stage.make_observation(0, TAIL_S_M)
    assert observation.world is not None
    assert observation.trajectory is not None
    contacts = [
        make_contact("peg", (3.0, force_n, 4.0), link)
        for link, force_n in ((0, 12.0), (4, 0.0), (4, 20.0), (13, 7.0))
    ]
    forces_n = np.zeros(14)
    for contact in contacts:
        forces_n[contact.link] += np.linalg.norm(contact.force_w)
    velocity, torque = draw.normal(0.0, 1.0, 13).tolist(), draw.normal(0.0, 3.0, 13).tolist()
    joints = msgspec.structs.replace(observation.joints, velocity_rad_s=velocity, torque_nm=torque)
    nodes = PlanarBody(stage.robot).compute_body_points_w(observation.world, joints.angle_rad)
    goal_w = nodes[:, -1] + np.array([0.5, 2.0])
    bearing_rad = np.arctan2(2.0, 0.5) - np.arctan2(*(nodes[:, -1] - nodes[:, 0])[::-1])
    session = onnxruntime.InferenceSession(POLICY_FOLDER / "lab.onnx")
    learned = msgspec.json.decode(session.get_modelmeta().custom_metadata_map["snakesim.learned"])
    sizes = {
        "time_s": 1,
        "goal_bearing": 2,
        "angle_rad": 13,
        "velocity_rad_s": 13,
        "torque_nm": 13,
        "contact_n": 14,
    }
    policy = PolicyArrays.make_from_parameters(learned, ["yaw"] * 13, sizes)
    goal = [np.cos(bearing_rad), np.sin(bearing_rad)]
    seen = [
        passed_s,
        *goal,
        *joints.angle_rad,
        *joints.velocity_rad_s,
        *joints.torque_nm,
        *forces_n,
    ]
    felt = replace(
        observation,
        joints=joints,
        world=msgspec.structs.replace(observation.world, contacts=contacts),
        trajectory=msgspec.structs.replace(observation.trajectory, goal_w=tuple(goal_w.tolist())),
    )
    wave = ForceFeedbackWave(stage.robot).compute_reference_rad(felt, passed_s)
    assert wave == pytest.approx(policy.compute_targets(np.array(seen, np.float32)), abs=1e-4)


def felt_by(stage: ObservationStage, torque_nm: float = 0.0) -> np.ndarray:
    """Angles of all joints of a straight body, whatever path there is."""
    joints = stage.make_observation(0, TAIL_S_M, torque_nm=torque_nm).joints
    straight = msgspec.structs.replace(joints, angle_rad=[0.0] * len(joints.angle_rad))
    observation = replace(stage.make_observation(0, TAIL_S_M, without="world"), joints=straight)
    return ForceFeedbackWave(stage.robot).compute_reference_rad(observation, 0.3)


def test_contact_search_bends_along_same_curve_for_any_joint_spacing() -> None:
    near, apart = felt_by(make_stage(13)), felt_by(make_stage(14, ("yaw", "pitch")))
    assert apart[::2] == pytest.approx(2.0 * near[::2])
    assert np.ptp(near) > 0.5
    assert not apart[1::2].any()


def test_contact_search_scales_torque_by_its_limit() -> None:
    weak, strong = (
        felt_by(make_stage(torque_nm=limit_nm), 0.2 * limit_nm) for limit_nm in (3.5, 7.0)
    )
    assert weak == pytest.approx(strong)
    assert weak != pytest.approx(felt_by(make_stage()))


def test_what_a_knock_is_felt_as_comes_over_several_ticks() -> None:
    stage = make_stage()
    observation = stage.make_observation(0, TAIL_S_M)
    knocked = replace(
        observation, joints=msgspec.structs.replace(observation.joints, velocity_rad_s=[20.0] * 13)
    )
    calm, struck = ForceFeedbackWave(stage.robot), ForceFeedbackWave(stage.robot)
    for wave in (calm, struck):
        wave.compute_reference_rad(observation, 0.01)
    apart = [
        np.ptp(
            [
                calm.compute_reference_rad(observation, 0.01),
                struck.compute_reference_rad(knocked, 0.01),
            ],
            axis=0,
        )
        for _ in range(20)
    ]
    assert np.max(np.diff(apart, axis=0)) < 0.11
    assert np.max(apart[0]) < 0.11
    assert np.max(apart[-1]) > 0.3  # rad


def test_smoothed_wave_does_not_follow_vibrating_torques() -> None:
    stage = make_stage()
    swings: list[float] = []
    for smoothing_s in (0.0, 0.1):
        wave = ForceFeedbackWave(stage.robot, smoothing_s=smoothing_s)
        angles: list[np.ndarray] = []
        for tick in range(100):
            torque_nm = 3.0 * math.copysign(1.0, math.sin(math.tau * 22.0 * 0.01 * tick))
            observation = stage.make_observation(tick, TAIL_S_M, torque_nm=torque_nm)
            angles.append(wave.compute_reference_rad(observation, 0.0 if tick == 0 else 0.01))
        swings.append(float(np.abs(np.diff(angles, n=2, axis=0))[20:].mean()))
    unsmoothed, smoothed = swings
    assert smoothed < 0.25 * unsmoothed


def test_smoothed_wave_starts_at_its_reference_and_follows_its_own_curve() -> None:
    stage = make_stage()
    smoothed = ForceFeedbackWave(stage.robot, smoothing_s=0.1)
    unsmoothed = ForceFeedbackWave(stage.robot)
    observation = stage.make_observation(0, TAIL_S_M)
    first = smoothed.compute_reference_rad(observation, 0.01)
    assert first == pytest.approx(unsmoothed.compute_reference_rad(observation, 0.01))
    lagging = smoothed.compute_reference_rad(observation, 0.01)
    expected = unsmoothed.compute_reference_rad(observation, 0.01)
    assert np.abs(lagging - first).max() < np.abs(expected - first).max()


def test_amplitude_scale_changes_the_wave_and_not_the_bend() -> None:
    stage = make_stage()
    observation = stage.make_observation(0, TAIL_S_M)
    quarter_s = 0.25 * math.tau / 5.391202  # the wave of the head is at its maximum
    narrow = ForceFeedbackWave(stage.robot).compute_reference_rad(observation, quarter_s)
    wide = ForceFeedbackWave(stage.robot, amplitude_scale=1.3).compute_reference_rad(
        observation, quarter_s
    )
    assert wide[-1] - narrow[-1] == pytest.approx(0.3 * 0.637896, rel=1e-3)


@pytest.mark.parametrize("speed_m_s", [0.2, -0.2])
def test_contact_search_of_moving_body_does_not_start(speed_m_s: float) -> None:
    stage, controller = searching()
    stage.speed_m_s = speed_m_s
    moving = [
        controller.update(stage.make_observation(tick, 1.5 + speed_m_s * 0.01 * tick))
        for tick in range(400)
    ]
    assert not any(SEARCHES in command.telemetry.reason for command in moving)


@pytest.mark.parametrize(
    "pegs",
    [[], [KnownObstacle(name="p", shape="cylinder", position_w=(0.5, 0.12, 0.1), radius_m=0.05)]],
)
def test_contact_search_of_u_shaped_body_raises_no_error(pegs: list[KnownObstacle]) -> None:
    stage = make_stage()
    turn = np.linspace(-np.pi / 2, np.pi / 2, 40)
    bend = np.column_stack([0.7 + 0.12 * np.cos(turn), 0.12 + 0.12 * np.sin(turn)])
    stage.route = Route([(-0.3, 0.0), *map(tuple, bend.tolist()), (-3.0, 0.24)])
    stage.pegs = pegs
    for tail_s_m in np.linspace(0.3, 0.7, 9):
        controller = ObstacleAided(stage.robot, ObstacleAidedParameters())
        for tick in range(5):
            assert np.isfinite(
                controller.update(stage.make_observation(tick, float(tail_s_m))).setpoints.target
            ).all()
