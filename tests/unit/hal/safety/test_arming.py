"""What a request for arming must name, and where targets may be."""

import numpy as np
import pytest

from snakesim_hal.safety.lifecycle import address_mismatches, far_targets
from snakesim_hal.wire.messages import LifecycleRequest, Mode
from tests.unit.hal.rig import command, description

ROBOT = description()
MAX = ROBOT.max_step_rad
NONE = np.zeros(len(ROBOT.joints), dtype=np.bool_)
GOOD = LifecycleRequest(action="arm", robot=ROBOT.robot, backend=ROBOT.backend, config_hash=ROBOT.config_hash)


def test_a_request_that_names_everything_has_no_mismatch() -> None:
    assert address_mismatches(GOOD, ROBOT) == []


@pytest.mark.parametrize(("given", "named"), [(None, "none"), ("abc", "'abc'")])
def test_a_request_without_the_configuration_says_what_to_do(given: str | None, named: str) -> None:
    request = LifecycleRequest(action="arm", robot=ROBOT.robot, backend=ROBOT.backend, config_hash=given)
    assert address_mismatches(request, ROBOT) == [
        (
            "wrong_config",
            f"the configuration is {ROBOT.config_hash!r}, the request names {named}: read hal/description, and arm "
            f"with its config_hash",
        )
    ]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_target_may_be_a_whole_step_away_and_no_further(side: float) -> None:
    here = np.zeros(len(ROBOT.joints))
    assert far_targets(command(ROBOT, side * MAX), here, ROBOT, NONE) == []
    further = np.nextafter(MAX, np.inf)
    assert len(far_targets(command(ROBOT, side * further), here, ROBOT, NONE)) == len(ROBOT.joints)


def test_only_staying_is_allowed() -> None:
    here = np.zeros(len(ROBOT.joints))
    assert far_targets(command(ROBOT, 9.0, Mode.PASSIVE), here, ROBOT, NONE) == []
    for mode in (Mode.VELOCITY, Mode.TORQUE):
        (first, *_) = far_targets(command(ROBOT, 0.0, mode), here, ROBOT, NONE)
        assert first == f"joint_1 is commanded in mode {mode.name.lower()}; it must hold its position at arming"


def test_a_joint_that_is_set_aside_may_be_anywhere() -> None:
    here, aside = np.zeros(len(ROBOT.joints)), NONE.copy()
    aside[1] = True
    reported = far_targets(command(ROBOT, 2 * MAX), here, ROBOT, aside)
    assert [words.partition(" ")[0] for words in reported] == ["joint_1", "joint_3"]
