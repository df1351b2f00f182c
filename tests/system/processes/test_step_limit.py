"""A watchdog interrupts a step that does not return, and never a later step."""

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


def run_endlessly() -> None:
    """Compute forever, and ignore ordinary exceptions."""
    while True:
        try:
            while True:
                pass
        except Exception:  # noqa: BLE001 - as in a careless controller
            pass


def test_step_watchdog_interrupts_endless_step_and_names_its_line() -> None:
    with closing(StepWatchdog(0.1)) as watchdog:
        with pytest.raises(StepTooLongError) as caught, watchdog:
            run_endlessly()
        assert describe_interrupted_line(caught.value).startswith(
            "run_endlessly() (test_step_limit.py line "
        )
        with watchdog:
            pass
        time.sleep(0.4)  # the watchdog raises no error between steps


def test_step_watchdog_at_shutdown_ends_step_before_its_limit() -> None:
    with closing(StepWatchdog(600.0)) as watchdog, pytest.raises(StepTooLongError), watchdog:
        watchdog.request_shutdown(0.1)
        run_endlessly()
    assert watchdog.is_shutting_down


def test_step_watchdog_raises_no_late_error_after_the_step() -> None:
    with closing(StepWatchdog(0.0)) as watchdog:
        for _ in range(20):
            try:
                with watchdog:
                    time.sleep(0.03)  # the error may be due at the end of compiled code
            except StepTooLongError:
                pass
        time.sleep(0.3)


def test_shared_step_times_contain_start_and_deadline_during_step() -> None:
    step_times = SharedStepTimes()
    with closing(StepWatchdog(60.0, step_times)) as watchdog:
        assert step_times.read_step_times() is None
        with watchdog:
            step = step_times.read_step_times()
            assert step is not None
            start_s, deadline_s = step
            assert deadline_s - start_s == pytest.approx(60.0)
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


def test_shared_step_times_read_during_changes_belong_together() -> None:
    result = subprocess.run(
        [sys.executable, "-c", READ_WHILE_STEPS_CHANGE],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert result.stdout == "True 0\n"
