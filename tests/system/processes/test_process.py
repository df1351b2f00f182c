"""Real-time settings of a process are applied where the system allows them, and reported where it refuses them."""

import os
import subprocess
import sys

import pytest

# Format strings of code: the first one limits locked memory in bytes, the second one prints the result of a function.
LIMIT_MEMORY_CODE = "import resource; resource.setrlimit(resource.RLIMIT_MEMLOCK, ({0}, {0})); "
PRINT_RESULT_CODE = "from snakesim_hal.base.process import {0}; print({0}({1}))"


def run_python(code: str, *, drop: str = "") -> str:
    """Run code in a new process and return what it prints.

    Args:
        code: the Python code.
        drop: a capability that the process must not have. The process of an ordinary user has none anyway.
    """
    prefix: list[str] = []
    if drop and os.geteuid() == 0:
        prefix = ["setpriv", f"--bounding-set=-{drop}", f"--inh-caps=-{drop}"]
    result = subprocess.run(
        [*prefix, sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    return (result.stdout + result.stderr).strip()


def test_lock_memory_under_limit_reports_the_limit() -> None:
    printed = run_python(
        LIMIT_MEMORY_CODE.format(1 << 20) + PRINT_RESULT_CODE.format("lock_memory", ""),
        drop="ipc_lock",
    )
    assert "the limit is 1024 KiB" in printed
    assert "ulimit -l" in printed


def test_lock_memory_where_allowed_locks_memory() -> None:
    code = (
        PRINT_RESULT_CODE.format("lock_memory", "")
        + "; print(open('/proc/self/status').read().split('VmLck:')[1].split()[0])"
    )
    verdict, *locked = run_python(code).splitlines()
    if verdict != "None":
        pytest.skip(verdict)
    assert int(locked[0]) > 1000


def test_enter_realtime_returns_and_prints_refused_settings() -> None:
    code = "from snakesim_hal.base.process import enter_realtime; r = enter_realtime(20); print(len(r), r)"
    printed = run_python(LIMIT_MEMORY_CODE.format(1 << 20) + code, drop="ipc_lock,-sys_nice")
    assert printed.startswith("2 ["), printed
    assert printed.count("no real-time priority") == 2, printed


def test_step_wall_clock_without_capability_is_refused() -> None:
    printed = run_python(PRINT_RESULT_CODE.format("step_wall_clock", "0.0"), drop="sys_time")
    assert "CAP_SYS_TIME" in printed
    assert "RefusedError" in printed


def test_realtime_thread_that_never_pauses_drops_its_priority() -> None:
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
    printed = run_python(code)
    if "refused" in printed:
        pytest.skip("real-time priority is refused here")
    assert printed.startswith("True\nTrue\n"), printed
    assert "priority dropped after computing for 50 ms without a pause" in printed


def test_closed_terminal_is_a_stop_signal_except_under_nohup() -> None:
    code = PRINT_RESULT_CODE.format("list_stop_signals", "")
    command = [sys.executable, "-c", code]
    as_in_terminal = ["env", "--default-signal=HUP"]  # these tests may run under nohup
    in_terminal = subprocess.run(
        [*as_in_terminal, *command], capture_output=True, text=True, check=True
    )
    under_nohup = subprocess.run(["nohup", *command], capture_output=True, text=True, check=True)
    assert "SIGHUP" in in_terminal.stdout
    assert "SIGTERM" in under_nohup.stdout
    assert "SIGHUP" not in under_nohup.stdout


def test_stop_signal_while_program_ends_keeps_its_exit_code() -> None:
    """Python restores the default handlers before it deletes the last objects, such as the one that sends SIGTERM."""
    code = """
import os, signal, sys
from snakesim_hal.base.process import call_on_stop_signals

class SentWhileProgramEnds:
    def __del__(self, kill=os.kill, own_pid=os.getpid()):
        kill(own_pid, signal_number)

signal_number = signal.SIGTERM
sender = SentWhileProgramEnds()
call_on_stop_signals(lambda: None)
sys.exit(4)
"""
    ended = subprocess.run([sys.executable, "-c", code], timeout=30, check=False)
    assert ended.returncode == 4
