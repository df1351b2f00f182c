"""What all gaits share: they start where the joints are, move without a jump, stop, reverse, and explain themselves."""

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_gnc.control.gaits.backbones import (
    FITTING_REASON,
    BackboneRolling,
    BackboneSidewinding,
    BackboneSidewindingParameters,
)
from snakesim_gnc.control.gaits.concertina import Concertina, compute_fold_fractions
from snakesim_gnc.control.gaits.cpg import Cpg
from snakesim_gnc.control.gaits.rectilinear import Rectilinear
from snakesim_gnc.control.gaits.serpenoid import Serpenoid, SerpenoidParameters
from snakesim_gnc.control.gaits.sinus_lifting import SinusLifting, SinusLiftingParameters
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand
from snakesim_testing.gnc.stage import PERIOD_S, ObservationStage, make_stage

PLANAR = [Serpenoid, Cpg, Concertina]
SPATIAL = [BackboneSidewinding, BackboneRolling, SinusLifting, Rectilinear]
MAX_STEP_RAD = 0.075  # of a target in a tick: what the limiter of this robot allows at 7.5 rad/s


def make_stage_for(gait: type[Controller[Any]]) -> ObservationStage:
    if gait in PLANAR:
        return make_stage(13)
    return make_stage(18, ("yaw", "pitch"))


def drive(
    controller: Controller[Any], stage: ObservationStage, ticks: range, **changes: Any
) -> list[ControllerCommand]:
    """The commands for a body that does not move. To lay it on the path again in every tick would take long."""
    seen = stage.make_observation(ticks.start, 0.3, **changes)
    observations = [dataclasses.replace(seen, tick=tick, time_s=tick * PERIOD_S) for tick in ticks]
    return [controller.update(observation) for observation in observations]


def list_targets(commands: list[ControllerCommand]) -> Floats:
    return np.array([command.setpoints.target for command in commands])


def list_references(commands: list[ControllerCommand]) -> Floats:
    return np.array([command.telemetry.reference_rad for command in commands])


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
def test_a_gait_starts_at_the_pose_and_never_jumps(gait: type[Controller[Any]]) -> None:
    stage = make_stage_for(gait)
    controller = gait(stage.robot, gait.Parameters())
    commands = drive(controller, stage, range(300))
    targets = list_targets(commands)
    measured_rad = np.array(stage.make_observation(0, 0.3).joints.angle_rad)
    assert np.abs(targets[0] - measured_rad).max() < 0.02
    assert np.abs(np.diff(targets, axis=0)).max() < MAX_STEP_RAD
    assert np.ptp(targets, axis=0).max() > 0.1


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
@pytest.mark.parametrize("without", ["world", "trajectory"])
def test_a_gait_that_stops_holds_and_continues_at_the_same_phase(
    gait: type[Controller[Any]], without: str
) -> None:
    stage = make_stage_for(gait)
    interrupted = gait(stage.robot, gait.Parameters())
    before = drive(interrupted, stage, range(250))
    held = drive(interrupted, stage, range(250, 350), without=without)
    after = drive(interrupted, stage, range(350, 400))
    targets = list_targets(before + held + after)
    assert np.abs(np.diff(targets, axis=0)).max() < MAX_STEP_RAD
    references = list_references(held)
    assert (references == list_references(before)[-1]).all()
    whole = gait(stage.robot, gait.Parameters())
    assert list_references(after) == pytest.approx(
        list_references(drive(whole, stage, range(300)))[250:]
    )


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
def test_a_gait_is_periodic(gait: type[Controller[Any]]) -> None:
    """After ten periods, in which the amplitudes of oscillators settle."""
    stage = make_stage_for(gait)
    parameters = msgspec.structs.replace(gait.Parameters(), period_s=1.0)
    controller = gait(stage.robot, parameters)
    references = list_references(drive(controller, stage, range(1200)))
    period_ticks = round(1.0 / PERIOD_S)
    assert np.abs(references[1199] - references[1199 - period_ticks]).max() < 0.005
    assert np.abs(references[1199] - references[1199 - period_ticks // 3]).max() > 0.1


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
def test_at_a_negative_speed_a_gait_runs_backward(gait: type[Controller[Any]]) -> None:
    stage = make_stage_for(gait)
    controller = gait(stage.robot, gait.Parameters())
    forward = list_references(drive(controller, stage, range(600)))
    stage.speed_m_s = -0.2
    backward = list_references(drive(controller, stage, range(600, 700)))
    assert np.abs(backward[80] - forward[-82]).max() < 0.05


@pytest.mark.parametrize("gait", SPATIAL)
def test_a_planar_robot_holds_and_states_the_missing_joints(gait: type[Controller[Any]]) -> None:
    stage = make_stage(13)
    controller = gait(stage.robot, gait.Parameters())
    commands = drive(controller, stage, range(50))
    targets = list_targets(commands)
    assert {command.telemetry.reason for command in commands} == {
        "this robot has no joints that turn up and down"
    }
    assert np.abs(targets - targets[0]).max() < 1e-9


@pytest.mark.parametrize("gait", PLANAR)
def test_a_robot_of_pitch_joints_holds_and_states_the_missing_joints(
    gait: type[Controller[Any]],
) -> None:
    stage = make_stage(6, ("pitch",))
    commands = drive(gait(stage.robot, gait.Parameters()), stage, range(20))
    assert {command.telemetry.reason for command in commands} == {
        "this robot has no joints that turn left and right"
    }


@pytest.mark.parametrize("gait", PLANAR)
def test_a_planar_gait_leaves_pitch_joints_straight(gait: type[Controller[Any]]) -> None:
    stage = make_stage(18, ("yaw", "pitch"))
    controller = gait(stage.robot, gait.Parameters())
    references = list_references(drive(controller, stage, range(200)))
    pitch = [i for i, joint in enumerate(stage.robot.joints) if joint.axis == "pitch"]
    assert np.abs(references[:, pitch]).max() == 0.0


@pytest.mark.parametrize("gait", [Serpenoid, Cpg])
def test_directional_control_bends_towards_the_path(gait: type[Controller[Any]]) -> None:
    """The body lies to the left of a path along x, or to its right."""
    sums: list[float] = []
    for offset_m in (0.5, -0.5):
        stage = make_stage(13)
        controller = gait(stage.robot, gait.Parameters())
        total = 0.0
        observation = stage.make_observation(0, 2.0)
        assert observation.trajectory is not None
        path_w = [(0.0, -offset_m), (6.0, -offset_m)]
        trajectory = msgspec.structs.replace(observation.trajectory, path_w=path_w)
        observation = dataclasses.replace(observation, trajectory=trajectory)
        for tick in range(640):
            command = controller.update(dataclasses.replace(observation, tick=tick))
            if tick >= 320:  # two periods
                total += float(np.mean(command.telemetry.reference_rad)) / 320
        sums.append(total)
    to_the_right, to_the_left = sums
    assert to_the_right < -0.02
    assert to_the_left > 0.02


@pytest.mark.parametrize("gait", [Serpenoid, Cpg])
def test_another_path_does_not_jerk_the_joints(gait: type[Controller[Any]]) -> None:
    """Its direction differs by two radians, and the joints move no faster than in the wave itself."""
    stage = make_stage(13)
    controller = gait(stage.robot, gait.Parameters())
    observation = stage.make_observation(0, 2.0)
    assert observation.trajectory is not None
    aside = msgspec.structs.replace(
        observation.trajectory, path_id=1, path_w=[(2.0, 0.0), (1.0, 4.0)]
    )
    replanned = dataclasses.replace(observation, trajectory=aside)
    references = list_references([controller.update(observation) for _ in range(480)])
    wave_step = np.abs(np.diff(references[160:], axis=0)).max()
    after = list_references([controller.update(replanned) for _ in range(160)])
    steps = np.abs(np.diff(np.vstack([references[-1:], after]), axis=0))
    assert steps.max() < 1.1 * wave_step


def test_serpenoid_wave_travels_from_head_to_tail() -> None:
    stage = make_stage(13)
    controller = Serpenoid(stage.robot, SerpenoidParameters(k_theta=0.0))
    references = list_references(drive(controller, stage, range(160)))
    peaks = references.argmax(axis=0)
    assert peaks[7] < peaks[6] < peaks[5]


def test_sinus_lifting_lifts_where_the_body_bends_most() -> None:
    """There the body is convex upward, so that the pitch joints bend down."""
    stage = make_stage(40, ("yaw", "pitch"))
    controller = SinusLifting(stage.robot, SinusLiftingParameters(wavelength=1.0))
    reference = list_references(drive(controller, stage, range(100)))[-1]
    sideways = reference[0::2] ** 2
    down = reference[1::2]
    assert np.corrcoef(sideways[2:-2], down[2:-2])[0, 1] > 0.8


def test_concertina_folds_one_half_while_the_other_holds() -> None:
    thirds = [
        compute_fold_fractions(phase)
        for phase in (0.0, 2.0 * np.pi / 3.0 - 1e-9, 4.0 * np.pi / 3.0 - 1e-9)
    ]
    assert np.array(thirds) == pytest.approx(
        np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]), abs=1e-6
    )
    fractions = np.array(
        [compute_fold_fractions(phase) for phase in np.linspace(0.0, 4.0 * np.pi, 400)]
    )
    assert np.abs(np.diff(fractions, axis=0)).max() < 0.05


def test_backbone_gaits_fit_before_they_move() -> None:
    stage = make_stage(18, ("yaw", "pitch"))
    controller = BackboneSidewinding(stage.robot, BackboneSidewindingParameters())
    commands = drive(controller, stage, range(60))
    reasons = [command.telemetry.reason for command in commands]
    assert reasons[0] == FITTING_REASON
    assert reasons[-1] == ""
    assert reasons.count(FITTING_REASON) < 25  # a quarter of a second
