"""Tests what each shipped controller does while it gets no world model or no trajectory.

In the middle of a run it holds its shape, and continues without a jump when the data is back.
"""

import numpy as np
import pytest

from snakesim_gnc.control.hold import HoldPose
from snakesim_gnc.control.obstacle_triplet import ObstacleTriplet
from snakesim_gnc.control.path_following import PathFollowing
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import make_stage

TAIL_S_M = 0.3
TORQUE_NM = 2.0  # measured torque of each joint, among them the propulsion joint
MAX_STEP_RAD = 0.02  # a larger change of a target within a tick is a jump
MAX_DRIFT_RAD = 2e-3  # of a held target within a second
CONTROLLERS = [HoldPose, PathFollowing, ObstacleTriplet]


@pytest.mark.parametrize("without", ["world", "trajectory"])
@pytest.mark.parametrize("plugin", CONTROLLERS)
def test_blind_controller_holds_shape_and_continues_without_jump(plugin, without):
    stage = make_stage()
    controller = plugin(stage.robot, plugin.Parameters())

    def update_controller(ticks, tail_s_m=TAIL_S_M, **changes):
        """Return the commands of these ticks."""
        return [
            controller.update(
                stage.make_observation(tick, tail_s_m, torque_nm=TORQUE_NM, **changes)
            )
            for tick in ticks
        ]

    last_seeing = update_controller(range(100))[-1]
    is_pushing = JointMode.TORQUE in last_seeing.setpoints.mode
    assert is_pushing == (plugin is ObstacleTriplet)

    blind_commands = update_controller(range(100, 300), without=without)
    assert all(set(command.setpoints.mode) == {JointMode.POSITION} for command in blind_commands)
    assert all(command.telemetry.propulsion_joint is None for command in blind_commands)
    targets_rad = np.array([command.setpoints.target for command in blind_commands])
    angles_rad = np.array(stage.make_observation(0, TAIL_S_M).joints.angle_rad)
    assert np.abs(np.diff(targets_rad, axis=0)).max() < MAX_STEP_RAD
    assert np.abs(targets_rad[-1] - targets_rad[-100]).max() < MAX_DRIFT_RAD
    if is_pushing:
        # The torque of the propulsion joint fades: no position target far away keeps it up.
        joint = last_seeing.setpoints.mode.index(JointMode.TORQUE)
        stiffness = stage.robot.joints[joint].stiffness_nm_per_rad
        first_torque_nm = abs(targets_rad[0, joint] - angles_rad[joint]) * stiffness
        last_torque_nm = abs(targets_rad[-1, joint] - angles_rad[joint]) * stiffness
        assert first_torque_nm == pytest.approx(TORQUE_NM, rel=0.2)
        assert last_torque_nm < 0.05 * TORQUE_NM

    # The body has slid a little meanwhile.
    seeing_commands = update_controller(range(300, 360), tail_s_m=TAIL_S_M + 0.02)
    first_seeing = seeing_commands[0].setpoints
    steps_rad = np.array(first_seeing.target) - targets_rad[-1]
    is_in_position_mode = np.array([mode == JointMode.POSITION for mode in first_seeing.mode])
    assert np.abs(steps_rad[is_in_position_mode]).max() < MAX_STEP_RAD
    assert (JointMode.TORQUE in seeing_commands[-1].setpoints.mode) == is_pushing


@pytest.mark.parametrize("without", ["world", "trajectory"])
@pytest.mark.parametrize("plugin", [PathFollowing, ObstacleTriplet])
def test_blind_controller_before_first_data_holds_pose_and_states_reason(plugin, without):
    stage = make_stage()
    controller = plugin(stage.robot, plugin.Parameters())
    observation = stage.make_observation(0, TAIL_S_M, without=without)
    first = controller.update(observation)
    expected_reasons = {"world": "no world model", "trajectory": "no trajectory"}
    assert first.telemetry.reason == expected_reasons[without]
    assert first.setpoints.target == pytest.approx(observation.joints.angle_rad)
    assert set(first.setpoints.mode) == {JointMode.POSITION}
    # A joint that has been turned does not change the held targets.
    second = controller.update(
        stage.make_observation(1, TAIL_S_M, without=without, turned={3: 0.2})
    )
    assert second.setpoints.target == pytest.approx(first.setpoints.target)
