"""Tests the commands of path following for synthetic observations, without physics."""

import numpy as np
import pytest

from snakesim_gnc.control.path_following import PathFollowing, PathFollowingParameters
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import compute_body_points, make_stage

TAIL_S_M = 0.3


def make_controller(stage, **parameters) -> PathFollowing:
    return PathFollowing(stage.robot, PathFollowingParameters(**parameters))


def test_path_following_of_blocked_body_leads_by_look_ahead():
    stage = make_stage()
    controller = make_controller(stage, look_ahead_m=0.03)
    command = [controller.update(stage.make_observation(tick, TAIL_S_M)) for tick in range(200)][-1]
    assert set(command.setpoints.mode) == {JointMode.POSITION}
    # The targets are the angles of a body that is ahead by the look-ahead distance.
    body_ahead_w = compute_body_points(stage, TAIL_S_M + 0.03)
    headings_rad = np.arctan2(*np.diff(body_ahead_w)[::-1])
    assert command.setpoints.target == pytest.approx(np.diff(headings_rad), abs=0.01)
    assert command.telemetry.path_s_m == pytest.approx(TAIL_S_M, abs=1e-3)
    assert command.telemetry.usable_push_points is None


def test_path_following_reference_moves_at_the_speed_of_the_mission():
    stage = make_stage()
    moved_rad: list[float] = []
    for speed_m_s in (0.0, 0.1, 0.3):
        stage.speed_m_s = speed_m_s
        controller = make_controller(stage, look_ahead_m=0.2)
        references = [
            controller.update(stage.make_observation(tick, TAIL_S_M)).telemetry.reference_rad
            for tick in range(31)
        ]
        moved_rad.append(np.abs(np.array(references[-1]) - references[0]).max())
    stopped, slow, fast = moved_rad
    assert fast > 2 * slow > 0
    assert stopped < 1e-3


def test_path_following_starts_without_a_jump():
    stage = make_stage()
    observation = stage.make_observation(0, TAIL_S_M)
    command = make_controller(stage).update(observation)
    steps_rad = np.abs(np.array(command.setpoints.target) - observation.joints.angle_rad)
    assert steps_rad.max() < 0.02
