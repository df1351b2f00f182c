"""A step that does not return is interrupted, and no later one is."""

import time
from contextlib import closing

import pytest

from snakesim_hal.base.step_limit import (
    SharedStepTimes,
    StepTooLongError,
    StepWatchdog,
    describe_interrupted_line,
)


def endless() -> None:
    while True:
        try:
            while True:
                pass
        except Exception:  # noqa: BLE001 - as a controller may have it
            pass


def test_an_endless_step_is_interrupted_and_its_place_is_known() -> None:
    with closing(StepWatchdog(0.1)) as limit:
        with pytest.raises(StepTooLongError) as caught, limit:
            endless()
        assert describe_interrupted_line(caught.value).startswith(
            "endless() (test_step_limit.py line "
        )
        with limit:
            pass
        time.sleep(0.4)  # between steps nothing is raised


def test_a_hurry_ends_the_present_step_long_before_its_limit() -> None:
    with closing(StepWatchdog(600.0)) as limit, pytest.raises(StepTooLongError), limit:
        limit.request_shutdown(0.1)
        endless()
    assert limit.is_shutting_down


def test_an_error_that_was_not_raised_yet_is_taken_back() -> None:
    with closing(StepWatchdog(0.0)) as limit:
        for _ in range(20):
            try:
                with limit:
                    time.sleep(0.03)  # compiled code, at whose end the error may be due
            except StepTooLongError:
                pass
        time.sleep(0.3)


def test_another_process_can_see_when_a_step_began() -> None:
    step_times = SharedStepTimes()
    with closing(StepWatchdog(60.0, step_times)) as limit:
        assert step_times.read_step_times() is None
        with limit:
            step_s = step_times.read_step_times()
            assert step_s is not None
            assert step_s[1] - step_s[0] == pytest.approx(60.0)
        assert step_times.read_step_times() is None
