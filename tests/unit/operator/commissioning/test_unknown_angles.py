"""How long a joint angle may be unknown."""

import pytest

from snakesim_hal.base.errors import RefusedError
from snakesim_operator.features.commissioning.unknown_angles import (
    MAX_UNKNOWN_S,
    UnknownAngleTimeout,
)
from snakesim_testing.messages import raises_error


class AdjustableTime:
    """A time that a test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def time() -> AdjustableTime:
    return AdjustableTime()


def test_angle_that_stays_unknown_is_refused_by_the_name_of_its_joint(time: AdjustableTime) -> None:
    timeout = UnknownAngleTimeout(time)
    timeout.check(["joint_2"])
    time.now_s += MAX_UNKNOWN_S
    timeout.check(["joint_2"])
    time.now_s += 0.01
    with raises_error(RefusedError, code="commissioning/not-possible", field="joint_2"):
        timeout.check(["joint_2"])


def test_angle_that_is_known_in_between_is_not_refused(time: AdjustableTime) -> None:
    timeout = UnknownAngleTimeout(time)
    for _ in range(10):
        timeout.check(["joint_1"])
        time.now_s += 0.6 * MAX_UNKNOWN_S
        timeout.check([])
        time.now_s += 0.6 * MAX_UNKNOWN_S


def test_time_before_the_first_unknown_angle_does_not_count(time: AdjustableTime) -> None:
    timeout = UnknownAngleTimeout(time)
    time.now_s += 10 * MAX_UNKNOWN_S
    timeout.check(["joint_1"])
