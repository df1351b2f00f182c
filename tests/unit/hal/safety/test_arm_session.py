"""Where targets may be for an arming."""

import numpy as np
import pytest

from snakesim_hal.safety.lifecycle import find_far_targets
from snakesim_testing.hal.small_robots import make_description, make_joint_command

ROBOT = make_description()
MAX = ROBOT.max_step_rad
NONE = np.zeros(len(ROBOT.joints), dtype=np.bool_)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_arming_target_may_be_one_step_away_at_most(side: float) -> None:
    here = np.zeros(len(ROBOT.joints))
    assert find_far_targets(make_joint_command(ROBOT, side * MAX), here, ROBOT, NONE) == []
    further = np.nextafter(MAX, np.inf)
    assert len(
        find_far_targets(make_joint_command(ROBOT, side * further), here, ROBOT, NONE)
    ) == len(ROBOT.joints)


def test_a_joint_that_is_set_aside_may_be_anywhere() -> None:
    here, aside = np.zeros(len(ROBOT.joints)), NONE.copy()
    aside[1] = True
    reported = find_far_targets(make_joint_command(ROBOT, 2 * MAX), here, ROBOT, aside)
    assert [words.partition(" ")[0] for words in reported] == ["joint_1", "joint_3"]
