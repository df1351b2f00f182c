"""Measures for real time: taken where the system allows them, and otherwise named."""

import os
import subprocess
import sys

import pytest

LOCK = "import resource; resource.setrlimit(resource.RLIMIT_MEMLOCK, ({0}, {0})); "
PRINT = "from snakesim_hal.base.process import {0}; print({0}({1}))"


def run_python(code: str, *, drop: str = "") -> str:
    """What a process of its own prints; drop: a capability that it must not have (an ordinary user's has none)."""
    bounded = (
        ["setpriv", f"--bounding-set=-{drop}", f"--inh-caps=-{drop}"]
        if drop and os.geteuid() == 0
        else []
    )
    done = subprocess.run(
        [*bounded, sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    return (done.stdout + done.stderr).strip()


def test_memory_is_not_locked_under_a_limit() -> None:
    words = run_python(LOCK.format(1 << 20) + PRINT.format("lock_memory", ""), drop="ipc_lock")
    assert "the limit is 1024 KiB" in words
    assert "ulimit -l" in words


def test_memory_is_locked_where_that_is_allowed() -> None:
    code = (
        PRINT.format("lock_memory", "")
        + "; print(open('/proc/self/status').read().split('VmLck:')[1].split()[0])"
    )
    verdict, *locked = run_python(code).splitlines()
    if verdict != "None":
        pytest.skip(verdict)
    assert int(locked[0]) > 1000


def test_what_is_refused_is_returned_and_printed() -> None:
    code = "from snakesim_hal.base.process import enter_realtime; r = enter_realtime(20); print(len(r), r)"
    words = run_python(LOCK.format(1 << 20) + code, drop="ipc_lock,-sys_nice")
    assert words.startswith("2 [") and words.count("no real-time priority") == 2, words


def test_the_clock_is_not_stepped_without_permission() -> None:
    words = run_python(PRINT.format("step_wall_clock", "0.0"), drop="sys_time")
    assert "CAP_SYS_TIME" in words
    assert "RefusedError" in words


def test_a_thread_that_never_pauses_gives_up_its_priority() -> None:
    code = """
import os, time
from snakesim_hal.base.process import drop_priority_after, set_realtime_priority
if set_realtime_priority(5) is not None:
    raise SystemExit("refused")
drop_priority_after(0.05)
def compute(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass
for _ in range(20):
    compute(0.01)
    time.sleep(0.001)
print(os.sched_getscheduler(0) == os.SCHED_FIFO)
compute(0.5)
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
"""
    words = run_python(code)
    if "refused" in words:
        pytest.skip("real-time priority is refused here")
    assert words.startswith("True\nTrue\n"), words
    assert "priority dropped after computing for 50 ms without a pause" in words


def test_a_closed_terminal_is_a_stop_but_under_nohup() -> None:
    code = PRINT.format("list_stop_signals", "")
    in_a_terminal = ["env", "--default-signal=HUP"]  # these tests may run under nohup
    words, under_nohup = (
        subprocess.run(
            [*prefix, sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        for prefix in (in_a_terminal, ["nohup"])
    )
    assert "SIGHUP" in words
    assert "SIGTERM" in under_nohup
    assert "SIGHUP" not in under_nohup
