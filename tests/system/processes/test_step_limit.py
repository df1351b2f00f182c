"""A step that does not return is interrupted, and no later one is."""

import subprocess
import sys
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


# The child starts and ends steps as fast as it can. Its parent counts times that belong to no step.
READ_WHILE_STEPS_CHANGE = """
import os
import time

from snakesim_hal.base.step_limit import SharedStepTimes

STEP_TIMEOUT_S = 60.0
step_times = SharedStepTimes()
child_pid = os.fork()
if child_pid == 0:
    end_s = time.monotonic() + 1.0
    while (now_s := time.monotonic()) < end_s:
        step_times.record_step_start(now_s, now_s + STEP_TIMEOUT_S)
        step_times.record_step_end()
    os._exit(0)
read_count = 0
wrong_count = 0
while os.waitpid(child_pid, os.WNOHANG) == (0, 0):
    for _ in range(1000):
        read = step_times.read_step_times()
        if read is not None:
            start_s, deadline_s = read
            read_count += 1
            wrong_count += abs(deadline_s - start_s - STEP_TIMEOUT_S) > 1.0
print(read_count > 0, wrong_count)
"""


def test_step_times_read_while_steps_change_are_never_mixed_up() -> None:
    completed = subprocess.run(
        [sys.executable, "-c", READ_WHILE_STEPS_CHANGE],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert completed.stdout == "True 0\n"
