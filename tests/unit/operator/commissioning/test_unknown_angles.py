"""Checks how long a joint angle may be unknown until the program refuses to continue."""

import pytest

from snakesim_hal.base.errors import RefusedError
from snakesim_operator.features.commissioning.unknown_angles import (
    MAX_UNKNOWN_S,
    UnknownAngleTimeout,
)
from snakesim_testing.messages import raises_error


class AdjustableClock:
    """A clock whose time a test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> AdjustableClock:
    return AdjustableClock()


def test_unknown_angle_beyond_timeout_is_refused_by_joint_name(clock: AdjustableClock) -> None:
    timeout = UnknownAngleTimeout(clock)
    timeout.check(["joint_2"])
    clock.now_s += MAX_UNKNOWN_S
    timeout.check(["joint_2"])
    clock.now_s += 0.01
    with raises_error(RefusedError, code="commissioning/not-possible", field="joint_2"):
        timeout.check(["joint_2"])


def test_unknown_angle_with_known_samples_between_is_not_refused(clock: AdjustableClock) -> None:
    timeout = UnknownAngleTimeout(clock)
    for _ in range(10):
        timeout.check(["joint_1"])
        clock.now_s += 0.6 * MAX_UNKNOWN_S
        timeout.check([])
        clock.now_s += 0.6 * MAX_UNKNOWN_S


def test_unknown_angle_timeout_starts_at_the_first_unknown_angle(clock: AdjustableClock) -> None:
    timeout = UnknownAngleTimeout(clock)
    clock.now_s += 10 * MAX_UNKNOWN_S
    timeout.check(["joint_1"])
