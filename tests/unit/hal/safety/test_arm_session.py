"""Arming requires targets that are near the joints."""

import numpy as np
import pytest

from snakesim_hal.safety.lifecycle import find_far_targets
from snakesim_testing.hal.small_robots import make_description, make_joint_command

ROBOT = make_description()
MAX_STEP_RAD = ROBOT.max_step_rad
NO_JOINTS = np.zeros(len(ROBOT.joints), dtype=np.bool_)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_arming_target_more_than_one_step_away_is_refused(side: float) -> None:
    angles_rad = np.zeros(len(ROBOT.joints))
    assert (
        find_far_targets(
            make_joint_command(ROBOT, side * MAX_STEP_RAD), angles_rad, ROBOT, NO_JOINTS
        )
        == []
    )
    beyond_rad = np.nextafter(MAX_STEP_RAD, np.inf)
    assert len(
        find_far_targets(make_joint_command(ROBOT, side * beyond_rad), angles_rad, ROBOT, NO_JOINTS)
    ) == len(ROBOT.joints)


def test_arming_target_of_isolated_joint_may_be_anywhere() -> None:
    angles_rad = np.zeros(len(ROBOT.joints))
    is_isolated = NO_JOINTS.copy()
    is_isolated[1] = True
    descriptions = find_far_targets(
        make_joint_command(ROBOT, 2 * MAX_STEP_RAD), angles_rad, ROBOT, is_isolated
    )
    assert [description.partition(" ")[0] for description in descriptions] == ["joint_1", "joint_3"]
