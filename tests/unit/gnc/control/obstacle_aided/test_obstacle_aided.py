"""Tests when `obstacle_aided` uses torque mode and position mode. Tests of runs are in tests/system/physics."""

import numpy as np
import pytest

from snakesim_gnc.control.obstacle_aided import ObstacleAided, ObstacleAidedParameters
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import make_stage

MEASURED_NM = 0.6  # torque of each joint


@pytest.mark.parametrize("missing_input", ["world", "trajectory"])
def test_obstacle_aided_leaving_torque_mode_holds_with_present_torque(missing_input: str):
    stage = make_stage()
    controller = ObstacleAided(stage.robot, ObstacleAidedParameters())
    observations = [stage.make_observation(tick, 1.0, torque_nm=MEASURED_NM) for tick in range(40)]
    pushing = [controller.update(observation) for observation in observations][-1].setpoints
    assert set(pushing.mode) == {JointMode.TORQUE}
    assert np.abs(pushing.target).max() > 0.1

    holding = controller.update(
        stage.make_observation(40, 1.0, torque_nm=MEASURED_NM, without=missing_input)
    ).setpoints
    assert set(holding.mode) == {JointMode.POSITION}
    stiffness = [joint.stiffness_nm_per_rad for joint in stage.robot.joints]
    holding_torque_nm = (np.array(holding.target) - observations[-1].joints.angle_rad) * stiffness
    assert holding_torque_nm == pytest.approx(MEASURED_NM, rel=0.1)


def test_obstacle_aided_body_without_push_holds_in_position_mode():
    stage = make_stage()
    stage.pegs = []
    controller = ObstacleAided(stage.robot, ObstacleAidedParameters())
    commands = [controller.update(stage.make_observation(tick, 1.0)) for tick in range(40)]
    assert set(commands[-1].setpoints.mode) == {JointMode.POSITION}


def test_drive_damping_of_resting_body_gives_torques_of_torque_mode():
    """At rest the damping is zero, so the position targets must give the same torques."""
    stage = make_stage()
    without_damping = ObstacleAided(stage.robot, ObstacleAidedParameters(shape_nm_s_per_rad=0.0))
    with_damping = ObstacleAided(
        stage.robot, ObstacleAidedParameters(shape_nm_s_per_rad=0.0, drive_damping=True)
    )
    observations = [stage.make_observation(tick, 1.0) for tick in range(40)]
    torques = [without_damping.update(observation) for observation in observations][-1].setpoints
    targets = [with_damping.update(observation) for observation in observations][-1].setpoints
    assert set(torques.mode) == {JointMode.TORQUE}
    assert set(targets.mode) == {JointMode.POSITION}
    assert np.abs(torques.target).max() > 0.1
    stiffness = [joint.stiffness_nm_per_rad for joint in stage.robot.joints]
    drive_torque_nm = (np.array(targets.target) - observations[-1].joints.angle_rad) * stiffness
    assert drive_torque_nm == pytest.approx(torques.target, abs=0.02)


def test_front_correction_puts_only_front_joints_in_position_mode():
    stage = make_stage()
    parameters = ObstacleAidedParameters(front_correction_m=0.25)
    controller = ObstacleAided(stage.robot, parameters)
    observations = [stage.make_observation(tick, 1.0) for tick in range(40)]
    setpoints = [controller.update(observation) for observation in observations][-1].setpoints
    is_stiff = [mode is JointMode.POSITION for mode in setpoints.mode]
    # The front is one piece that ends at the head.
    assert is_stiff == sorted(is_stiff)
    assert not all(is_stiff)
