"""Tests what all gaits have in common.

They start at the measured angles, move without a jump, stop, reverse, and state a reason while they cannot move.
"""

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


def command_standing_body(
    controller: Controller[Any], stage: ObservationStage, ticks: range, **changes: Any
) -> list[ControllerCommand]:
    """Return the commands for a body that does not move. Its pose is computed once, because this takes long."""
    first = stage.make_observation(ticks.start, 0.3, **changes)
    observations = [dataclasses.replace(first, tick=tick, time_s=tick * PERIOD_S) for tick in ticks]
    return [controller.update(observation) for observation in observations]


def list_targets(commands: list[ControllerCommand]) -> Floats:
    return np.array([command.setpoints.target for command in commands])


def list_references(commands: list[ControllerCommand]) -> Floats:
    return np.array([command.telemetry.reference_rad for command in commands])


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
def test_gait_starts_at_measured_pose_and_never_jumps(gait: type[Controller[Any]]) -> None:
    stage = make_stage_for(gait)
    controller = gait(stage.robot, gait.Parameters())
    commands = command_standing_body(controller, stage, range(300))
    targets = list_targets(commands)
    measured_rad = np.array(stage.make_observation(0, 0.3).joints.angle_rad)
    assert np.abs(targets[0] - measured_rad).max() < 0.02
    assert np.abs(np.diff(targets, axis=0)).max() < MAX_STEP_RAD
    assert np.ptp(targets, axis=0).max() > 0.1


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
@pytest.mark.parametrize("without", ["world", "trajectory"])
def test_gait_without_input_holds_and_continues_at_same_phase(
    gait: type[Controller[Any]], without: str
) -> None:
    stage = make_stage_for(gait)
    interrupted = gait(stage.robot, gait.Parameters())
    commands_before = command_standing_body(interrupted, stage, range(250))
    commands_without_input = command_standing_body(
        interrupted, stage, range(250, 350), without=without
    )
    commands_after = command_standing_body(interrupted, stage, range(350, 400))
    targets = list_targets(commands_before + commands_without_input + commands_after)
    assert np.abs(np.diff(targets, axis=0)).max() < MAX_STEP_RAD
    references = list_references(commands_without_input)
    assert (references == list_references(commands_before)[-1]).all()
    uninterrupted = gait(stage.robot, gait.Parameters())
    assert list_references(commands_after) == pytest.approx(
        list_references(command_standing_body(uninterrupted, stage, range(300)))[250:]
    )


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
def test_gait_references_are_periodic(gait: type[Controller[Any]]) -> None:
    """The amplitudes of oscillators settle within the first ten periods."""
    stage = make_stage_for(gait)
    parameters = msgspec.structs.replace(gait.Parameters(), period_s=1.0)
    controller = gait(stage.robot, parameters)
    references = list_references(command_standing_body(controller, stage, range(1200)))
    period_ticks = round(1.0 / PERIOD_S)
    assert np.abs(references[1199] - references[1199 - period_ticks]).max() < 0.005
    assert np.abs(references[1199] - references[1199 - period_ticks // 3]).max() > 0.1


@pytest.mark.parametrize("gait", PLANAR + SPATIAL)
def test_gait_at_negative_speed_runs_backward(gait: type[Controller[Any]]) -> None:
    stage = make_stage_for(gait)
    controller = gait(stage.robot, gait.Parameters())
    forward = list_references(command_standing_body(controller, stage, range(600)))
    stage.speed_m_s = -0.2
    backward = list_references(command_standing_body(controller, stage, range(600, 700)))
    assert np.abs(backward[80] - forward[-82]).max() < 0.05


@pytest.mark.parametrize("gait", SPATIAL)
def test_spatial_gait_of_planar_robot_holds_and_states_missing_joints(
    gait: type[Controller[Any]],
) -> None:
    stage = make_stage(13)
    controller = gait(stage.robot, gait.Parameters())
    commands = command_standing_body(controller, stage, range(50))
    targets = list_targets(commands)
    assert {command.telemetry.reason for command in commands} == {
        "this robot has no joints that turn up and down"
    }
    assert np.abs(targets - targets[0]).max() < 1e-9


@pytest.mark.parametrize("gait", PLANAR)
def test_planar_gait_without_yaw_joints_states_missing_joints(
    gait: type[Controller[Any]],
) -> None:
    stage = make_stage(6, ("pitch",))
    commands = command_standing_body(gait(stage.robot, gait.Parameters()), stage, range(20))
    assert {command.telemetry.reason for command in commands} == {
        "this robot has no joints that turn left and right"
    }


@pytest.mark.parametrize("gait", PLANAR)
def test_planar_gait_leaves_pitch_joints_straight(gait: type[Controller[Any]]) -> None:
    stage = make_stage(18, ("yaw", "pitch"))
    controller = gait(stage.robot, gait.Parameters())
    references = list_references(command_standing_body(controller, stage, range(200)))
    pitch = [i for i, joint in enumerate(stage.robot.joints) if joint.axis == "pitch"]
    assert np.abs(references[:, pitch]).max() == 0.0


@pytest.mark.parametrize("gait", [Serpenoid, Cpg])
def test_gait_beside_its_path_bends_towards_it(gait: type[Controller[Any]]) -> None:
    """The body is 0.5 m to the left of a path along x, or to its right."""
    mean_angles_rad: list[float] = []
    for offset_m in (0.5, -0.5):
        stage = make_stage(13)
        controller = gait(stage.robot, gait.Parameters())
        mean_angle_rad = 0.0
        observation = stage.make_observation(0, 2.0)
        assert observation.trajectory is not None
        path_w = [(0.0, -offset_m), (6.0, -offset_m)]
        trajectory = msgspec.structs.replace(observation.trajectory, path_w=path_w)
        observation = dataclasses.replace(observation, trajectory=trajectory)
        for tick in range(640):
            command = controller.update(dataclasses.replace(observation, tick=tick))
            if tick >= 320:  # two periods
                mean_angle_rad += float(np.mean(command.telemetry.reference_rad)) / 320
        mean_angles_rad.append(mean_angle_rad)
    left_of_path_rad, right_of_path_rad = mean_angles_rad
    assert left_of_path_rad < -0.02
    assert right_of_path_rad > 0.02


@pytest.mark.parametrize("gait", [Serpenoid, Cpg])
def test_gait_on_new_path_does_not_jerk_the_joints(gait: type[Controller[Any]]) -> None:
    """The direction of the new path differs by two radians. The joints move no faster than in the wave itself."""
    stage = make_stage(13)
    controller = gait(stage.robot, gait.Parameters())
    observation = stage.make_observation(0, 2.0)
    assert observation.trajectory is not None
    new_trajectory = msgspec.structs.replace(
        observation.trajectory, path_id=1, path_w=[(2.0, 0.0), (1.0, 4.0)]
    )
    replanned = dataclasses.replace(observation, trajectory=new_trajectory)
    references = list_references([controller.update(observation) for _ in range(480)])
    max_wave_step_rad = np.abs(np.diff(references[160:], axis=0)).max()
    references_after = list_references([controller.update(replanned) for _ in range(160)])
    steps_rad = np.abs(np.diff(np.vstack([references[-1:], references_after]), axis=0))
    assert steps_rad.max() < 1.1 * max_wave_step_rad


def test_serpenoid_wave_travels_from_head_to_tail() -> None:
    stage = make_stage(13)
    controller = Serpenoid(stage.robot, SerpenoidParameters(k_theta=0.0))
    references = list_references(command_standing_body(controller, stage, range(160)))
    peaks = references.argmax(axis=0)
    assert peaks[7] < peaks[6] < peaks[5]


def test_sinus_lifting_lifts_where_the_body_bends_most() -> None:
    """Where the body bends most, it is convex upward, so that the pitch joints bend down."""
    stage = make_stage(40, ("yaw", "pitch"))
    controller = SinusLifting(stage.robot, SinusLiftingParameters(wavelength=1.0))
    reference_rad = list_references(command_standing_body(controller, stage, range(100)))[-1]
    squared_yaw = reference_rad[0::2] ** 2
    pitch_rad = reference_rad[1::2]
    assert np.corrcoef(squared_yaw[2:-2], pitch_rad[2:-2])[0, 1] > 0.8


def test_concertina_folds_one_half_while_the_other_holds() -> None:
    at_ends_of_thirds = [
        compute_fold_fractions(phase)
        for phase in (0.0, 2.0 * np.pi / 3.0 - 1e-9, 4.0 * np.pi / 3.0 - 1e-9)
    ]
    assert np.array(at_ends_of_thirds) == pytest.approx(
        np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]), abs=1e-6
    )
    fractions = np.array(
        [compute_fold_fractions(phase) for phase in np.linspace(0.0, 4.0 * np.pi, 400)]
    )
    assert np.abs(np.diff(fractions, axis=0)).max() < 0.05


def test_backbone_gaits_fit_before_they_move() -> None:
    stage = make_stage(18, ("yaw", "pitch"))
    controller = BackboneSidewinding(stage.robot, BackboneSidewindingParameters())
    commands = command_standing_body(controller, stage, range(60))
    reasons = [command.telemetry.reason for command in commands]
    assert reasons[0] == FITTING_REASON
    assert reasons[-1] == ""
    assert reasons.count(FITTING_REASON) < 25  # a quarter of a second
