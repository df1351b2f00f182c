"""Every shipped controller without a world model or a trajectory in the middle of a run: it holds, and goes on."""

import numpy as np
import pytest

from snakesim_gnc.control.hold import HoldPose
from snakesim_gnc.control.obstacle_triplet import ObstacleTriplet
from snakesim_gnc.control.path_following import PathFollowing
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import make_stage

TAIL_S_M = 0.3
TORQUE_NM = 2.0  # that every joint is said to have: what the propulsion joint pushes with
STEP_RAD = 0.02  # of a target within a tick, without a jump
CONTROLLERS = [HoldPose, PathFollowing, ObstacleTriplet]


@pytest.mark.parametrize("without", ["world", "trajectory"])
@pytest.mark.parametrize("plugin", CONTROLLERS)
def test_blind_controller_without_push_holds_and_continues_without_jump(plugin, without):
    stage = make_stage()
    controller = plugin(stage.robot, plugin.Parameters())

    def act(ticks, tail_s_m=TAIL_S_M, **more):
        return [
            controller.update(stage.make_observation(t, tail_s_m, torque_nm=TORQUE_NM, **more))
            for t in ticks
        ]

    before = act(range(100))[-1]
    pushing = JointMode.TORQUE in before.setpoints.mode
    assert pushing == (plugin is ObstacleTriplet)
    blind = act(range(100, 300), without=without)
    assert all(set(command.setpoints.mode) == {JointMode.POSITION} for command in blind)
    assert all(command.telemetry.propulsion_joint is None for command in blind)
    targets = np.array([command.setpoints.target for command in blind])
    angles = np.array(stage.make_observation(0, TAIL_S_M).joints.angle_rad)
    assert np.abs(np.diff(targets, axis=0)).max() < STEP_RAD
    assert np.abs(targets[-1] - targets[-100]).max() < 2e-3  # it stays
    # What the joint pushed with has faded, and is not kept up by a position target far away.
    if pushing:
        turn = before.setpoints.mode.index(JointMode.TORQUE)
        stiffness = stage.robot.joints[turn].stiffness_nm_per_rad
        assert abs(targets[0, turn] - angles[turn]) * stiffness == pytest.approx(TORQUE_NM, rel=0.2)
        assert abs(targets[-1, turn] - angles[turn]) * stiffness < 0.05 * TORQUE_NM
    back = act(range(300, 360), tail_s_m=TAIL_S_M + 0.02)  # it has slid a little meanwhile
    steps = np.array(back[0].setpoints.target) - targets[-1]
    steady = np.array([mode == JointMode.POSITION for mode in back[0].setpoints.mode])
    assert np.abs(steps[steady]).max() < STEP_RAD
    assert (JointMode.TORQUE in back[-1].setpoints.mode) == pushing


@pytest.mark.parametrize("without", ["world", "trajectory"])
@pytest.mark.parametrize("plugin", [PathFollowing, ObstacleTriplet])
def test_blind_controller_before_data_holds_pose_and_names_it(plugin, without):
    stage = make_stage()
    controller = plugin(stage.robot, plugin.Parameters())
    observation = stage.make_observation(0, TAIL_S_M, without=without)
    first = controller.update(observation)
    assert (
        first.telemetry.reason
        == {"world": "no world model", "trajectory": "no trajectory"}[without]
    )
    assert first.setpoints.target == pytest.approx(observation.joints.angle_rad)
    assert set(first.setpoints.mode) == {JointMode.POSITION}
    slid = controller.update(stage.make_observation(1, TAIL_S_M, without=without, turned={3: 0.2}))
    assert slid.setpoints.target == pytest.approx(first.setpoints.target)  # held, not followed
