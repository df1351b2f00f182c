"""Tests the contact search of `obstacle_aided`.

A body that does not advance moves by a wave until it can push off obstacles again. It enters and leaves the search
without a jump of its targets.
"""

import math
from collections.abc import Sequence
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
SEARCH_REASON = "in search of contacts"
MAX_STEP_RAD = 0.08  # of a target from one tick to the next; the waves themselves make 0.03
FORWARD_PERIOD_S = pytest.approx(0.8, rel=0.05)
FEEDBACK_PERIOD_S = pytest.approx(math.tau / 5.39, rel=0.15)
SLOW_FEEDBACK_PERIOD_S = pytest.approx(2 * math.tau / 5.39, rel=0.15)
PERIOD_TICKS = 240  # from which a period is measured


def make_searching_controller(
    *, among_pegs: bool = False, **parameters: float
) -> tuple[ObservationStage, ObstacleAided]:
    """Return a stage and a controller that searches for contacts after a second, unless configured otherwise."""
    stage = make_stage()
    stage.pegs = stage.pegs if among_pegs else []
    defaults = ObstacleAidedParameters(search_after_s=1.0)
    return stage, ObstacleAided(stage.robot, msgspec.structs.replace(defaults, **parameters))


def command_standing_body(
    controller: ObstacleAided, stage: ObservationStage, ticks: range
) -> list[ControllerCommand]:
    """Return the commands while the body stays where it is."""
    return [controller.update(stage.make_observation(tick, TAIL_S_M)) for tick in ticks]


def list_targets(commands: list[ControllerCommand]) -> np.ndarray:
    """Return the targets of each tick and joint."""
    return np.array([command.setpoints.target for command in commands])


def find_max_step_rad(commands: list[ControllerCommand]) -> float:
    """Return the largest change of a target from one tick to the next."""
    return float(np.abs(np.diff(list_targets(commands), axis=0)).max())


def is_searching(command: ControllerCommand) -> bool:
    return SEARCH_REASON in command.telemetry.reason


def measure_periods_s(commands: list[ControllerCommand], starts: Sequence[int]) -> list[float]:
    """Return the period of the head's wave after each of these commands."""
    return [measure_period_s(commands[start : start + PERIOD_TICKS]) for start in starts]


def measure_period_s(commands: list[ControllerCommand]) -> float:
    """Return the period of the sine that fits the targets of the head best."""
    head = list_targets(commands)[:, -1]
    times_s = 0.01 * np.arange(len(head))
    periods_s = np.arange(0.4, 4.0, 0.02)
    errors: list[float] = []
    for period in periods_s:
        phase_rad = math.tau * times_s / period
        basis = np.column_stack([np.sin(phase_rad), np.cos(phase_rad), np.ones_like(phase_rad)])
        fitted = basis @ np.linalg.lstsq(basis, head, rcond=None)[0]
        errors.append(float(np.sum((head - fitted) ** 2)))
    return float(periods_s[int(np.argmin(errors))])


def test_contact_search_of_standing_body_ends_when_it_can_push() -> None:
    stage, controller = make_searching_controller(
        search_after_s=1.2, search_s=2.0, shape_nm_per_rad=0.0
    )
    without_pegs = command_standing_body(controller, stage, range(300))
    searches = [is_searching(command) for command in without_pegs]
    assert not any(searches[:115])
    assert all(searches[125:])
    head_targets_rad = list_targets(without_pegs[125:])[:, -1]
    assert np.ptp(head_targets_rad) > 0.5

    stage.pegs = make_stage().pegs
    beside_pegs = command_standing_body(controller, stage, range(300, 400))
    assert not any(is_searching(command) for command in beside_pegs[25:])
    assert max(command.telemetry.propulsion_n or 0.0 for command in beside_pegs) > 5.0
    assert find_max_step_rad(without_pegs + beside_pegs) < MAX_STEP_RAD

    # The body does not advance by pushing either.
    assert is_searching(command_standing_body(controller, stage, range(400, 480))[-1])


@pytest.mark.parametrize("among_pegs", [True, False])
def test_contact_search_fruitless_wave_is_replaced_by_the_other(among_pegs: bool) -> None:
    stage, controller = make_searching_controller(among_pegs=among_pegs, shape_nm_per_rad=0.0)
    commands = command_standing_body(controller, stage, range(1010))
    first, second = FORWARD_PERIOD_S, FEEDBACK_PERIOD_S
    if among_pegs:
        first, second = second, first
    assert measure_periods_s(commands, (150, 450, 750)) == [first, second, first]
    assert find_max_step_rad(commands) < MAX_STEP_RAD


@pytest.mark.slow
def test_contact_search_wave_starts_slow_and_continues_fast() -> None:
    stage, controller = make_searching_controller(among_pegs=True, shape_nm_per_rad=0.0)
    for tick in range(100):
        controller.update(stage.make_observation(tick, TAIL_S_M - 0.15 + 0.0015 * tick))
    commands = command_standing_body(controller, stage, range(100, 1150))
    periods_s = measure_periods_s(commands, (150, 750))
    assert periods_s == [SLOW_FEEDBACK_PERIOD_S, FEEDBACK_PERIOD_S]
    assert find_max_step_rad(commands) < MAX_STEP_RAD


def test_contact_search_wave_that_advances_body_is_kept() -> None:
    stage, controller = make_searching_controller()
    command_standing_body(controller, stage, range(110))
    advancing = [
        controller.update(stage.make_observation(tick, TAIL_S_M + 0.0003 * (tick - 110)))
        for tick in range(110, 900)
    ]
    assert all(is_searching(command) for command in advancing)
    assert measure_periods_s(advancing, (60, 300, 540)) == [FORWARD_PERIOD_S] * 3


def test_contact_search_detects_standing_body_despite_pose_noise() -> None:
    stage, controller = make_searching_controller(search_after_s=1.2)
    random = np.random.default_rng(1)
    observations = (
        stage.make_observation(tick, TAIL_S_M + random.normal(0.0, 0.005)) for tick in range(300)
    )
    assert any(is_searching(controller.update(observation)) for observation in observations)


def test_contact_search_can_be_disabled() -> None:
    stage, controller = make_searching_controller(search_after_s=0.0)
    commands = command_standing_body(controller, stage, range(500))
    assert not any(is_searching(command) for command in commands)


def test_force_feedback_wave_equals_the_shipped_policy() -> None:
    stage = make_stage()
    time_s = 2.3
    random = np.random.default_rng(3)
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
    velocities_rad_s = random.normal(0.0, 1.0, 13).tolist()
    torques_nm = random.normal(0.0, 3.0, 13).tolist()
    joints = msgspec.structs.replace(
        observation.joints, velocity_rad_s=velocities_rad_s, torque_nm=torques_nm
    )
    body_w = PlanarBody(stage.robot).compute_body_points_w(observation.world, joints.angle_rad)
    goal_w = body_w[:, -1] + np.array([0.5, 2.0])
    body_direction_w = body_w[:, -1] - body_w[:, 0]
    bearing_rad = np.arctan2(2.0, 0.5) - np.arctan2(*body_direction_w[::-1])
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
    policy_inputs = [
        time_s,
        np.cos(bearing_rad),
        np.sin(bearing_rad),
        *joints.angle_rad,
        *joints.velocity_rad_s,
        *joints.torque_nm,
        *forces_n,
    ]
    observation = replace(
        observation,
        joints=joints,
        world=msgspec.structs.replace(observation.world, contacts=contacts),
        trajectory=msgspec.structs.replace(observation.trajectory, goal_w=tuple(goal_w.tolist())),
    )
    reference_rad = ForceFeedbackWave(stage.robot).compute_reference_rad(observation, time_s)
    targets_rad = policy.compute_targets(np.array(policy_inputs, np.float32))
    assert reference_rad == pytest.approx(targets_rad, abs=1e-4)


def compute_straight_body_wave_rad(stage: ObservationStage, torque_nm: float = 0.0) -> np.ndarray:
    """Return the reference angles of the force feedback wave for a straight body without a world model."""
    joints = stage.make_observation(0, TAIL_S_M, torque_nm=torque_nm).joints
    straight = msgspec.structs.replace(joints, angle_rad=[0.0] * len(joints.angle_rad))
    observation = replace(stage.make_observation(0, TAIL_S_M, without="world"), joints=straight)
    return ForceFeedbackWave(stage.robot).compute_reference_rad(observation, 0.3)


def test_contact_search_bends_along_same_curve_for_any_joint_spacing() -> None:
    yaw_only_rad = compute_straight_body_wave_rad(make_stage(13))
    alternating_rad = compute_straight_body_wave_rad(make_stage(14, ("yaw", "pitch")))
    assert alternating_rad[::2] == pytest.approx(2.0 * yaw_only_rad[::2])
    assert np.ptp(yaw_only_rad) > 0.5
    assert not alternating_rad[1::2].any()


def test_contact_search_scales_torque_by_its_limit() -> None:
    weak_rad, strong_rad = (
        compute_straight_body_wave_rad(make_stage(torque_nm=limit_nm), 0.2 * limit_nm)
        for limit_nm in (3.5, 7.0)
    )
    assert weak_rad == pytest.approx(strong_rad)
    assert weak_rad != pytest.approx(compute_straight_body_wave_rad(make_stage()))


def test_force_feedback_wave_follows_a_knock_over_several_ticks() -> None:
    stage = make_stage()
    observation = stage.make_observation(0, TAIL_S_M)
    fast_joints = msgspec.structs.replace(observation.joints, velocity_rad_s=[20.0] * 13)
    knocked_observation = replace(observation, joints=fast_joints)
    calm_wave = ForceFeedbackWave(stage.robot)
    knocked_wave = ForceFeedbackWave(stage.robot)
    for wave in (calm_wave, knocked_wave):
        wave.compute_reference_rad(observation, 0.01)
    differences_rad = [
        np.ptp(
            [
                calm_wave.compute_reference_rad(observation, 0.01),
                knocked_wave.compute_reference_rad(knocked_observation, 0.01),
            ],
            axis=0,
        )
        for _ in range(20)
    ]
    assert np.max(np.diff(differences_rad, axis=0)) < 0.11
    assert np.max(differences_rad[0]) < 0.11
    assert np.max(differences_rad[-1]) > 0.3


def test_smoothed_wave_does_not_follow_vibrating_torques() -> None:
    stage = make_stage()
    mean_accelerations: list[float] = []
    for smoothing_s in (0.0, 0.1):
        wave = ForceFeedbackWave(stage.robot, smoothing_s=smoothing_s)
        angles: list[np.ndarray] = []
        for tick in range(100):
            torque_nm = 3.0 * math.copysign(1.0, math.sin(math.tau * 22.0 * 0.01 * tick))
            observation = stage.make_observation(tick, TAIL_S_M, torque_nm=torque_nm)
            angles.append(wave.compute_reference_rad(observation, 0.0 if tick == 0 else 0.01))
        mean_accelerations.append(float(np.abs(np.diff(angles, n=2, axis=0))[20:].mean()))
    unsmoothed, smoothed = mean_accelerations
    assert smoothed < 0.25 * unsmoothed


def test_smoothed_wave_starts_at_its_reference_and_then_lags() -> None:
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
    stage, controller = make_searching_controller()
    stage.speed_m_s = speed_m_s
    commands = [
        controller.update(stage.make_observation(tick, 1.5 + speed_m_s * 0.01 * tick))
        for tick in range(400)
    ]
    assert not any(is_searching(command) for command in commands)


@pytest.mark.parametrize(
    "pegs",
    [[], [KnownObstacle(name="p", shape="cylinder", position_w=(0.5, 0.12, 0.1), radius_m=0.05)]],
)
def test_contact_search_of_u_shaped_body_raises_no_error(pegs: list[KnownObstacle]) -> None:
    stage = make_stage()
    angles_rad = np.linspace(-np.pi / 2, np.pi / 2, 40)
    bend_m = np.column_stack([0.7 + 0.12 * np.cos(angles_rad), 0.12 + 0.12 * np.sin(angles_rad)])
    stage.route = Route([(-0.3, 0.0), *map(tuple, bend_m.tolist()), (-3.0, 0.24)])
    stage.pegs = pegs
    for tail_s_m in np.linspace(0.3, 0.7, 9):
        controller = ObstacleAided(stage.robot, ObstacleAidedParameters())
        for tick in range(5):
            command = controller.update(stage.make_observation(tick, float(tail_s_m)))
            assert np.isfinite(command.setpoints.target).all()
