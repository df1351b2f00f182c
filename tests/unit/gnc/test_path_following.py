"""Path following on observations made by hand."""

import numpy as np
import pytest

from snakesim_gnc.control.path_following import PathFollowing, PathFollowingParameters
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import compute_body_points, make_stage

TAIL_S_M = 0.3


def make_controller(stage, **parameters) -> PathFollowing:
    return PathFollowing(stage.robot, PathFollowingParameters(**parameters))


def test_path_following_held_body_is_commanded_at_most_look_ahead():
    stage = make_stage()
    controller = make_controller(stage, look_ahead_m=0.03)
    command = [controller.update(stage.make_observation(tick, TAIL_S_M)) for tick in range(200)][-1]
    assert set(command.setpoints.mode) == {JointMode.POSITION}
    nodes = compute_body_points(stage, TAIL_S_M + 0.03)
    headings = np.arctan2(*np.diff(nodes)[::-1])
    assert command.setpoints.target == pytest.approx(np.diff(headings), abs=0.01)
    assert command.telemetry.path_s_m == pytest.approx(TAIL_S_M, abs=1e-3)
    assert command.telemetry.usable_push_points is None


def test_the_reference_moves_with_the_mission_and_stops_with_it():
    stage, moved_rad = make_stage(), []
    for stage.speed_m_s in (0.0, 0.1, 0.3):
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
    steps = np.abs(np.array(command.setpoints.target) - observation.joints.angle_rad)
    assert steps.max() < 0.02
