"""Processes that never outlive their parent, and that shut down in order on a signal."""

import atexit
import contextlib
import ctypes
import gc
import getpass
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import NoReturn

from snakesim_hal.base.errors import RefusedError
from snakesim_hal.base.terminal import print_stderr

# SIGHUP means that the terminal or the ssh session was closed.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SEARCH_PATH = "PYTHONPATH"
SAFE_PATH = "PYTHONSAFEPATH"  # the variable that stands for Python's option -P
# Numbers of the Linux kernel, from <linux/prctl.h>, <linux/capability.h> and <bits/mman-linux.h>.
PR_SET_PDEATHSIG = 1
CAP_IPC_LOCK = 14
MCL_CURRENT = 1
MCL_FUTURE = 2
MCL_ONFAULT = 4
MIN_MEMORY_LIMIT = 2**30  # bytes: four times what a run allocates
SWITCH_INTERVAL_S = 0.0005  # of the interpreter; its default of 5 ms is half a control period
# Of 99: above every ordinary process, below the kernel's own threads. A controller that hangs does not delay the host.
HOST_PRIORITY = 20
SERVICE_PRIORITY = 19
MAX_USER_NAME_LENGTH = 64  # characters, as `quantities.Name` allows


def get_user_name() -> str:
    """Return the name of the user who runs this process, for status and logs."""
    try:
        return getpass.getuser()[:MAX_USER_NAME_LENGTH]
    except (KeyError, OSError):
        return "operator"


def make_python_command(*arguments: str) -> list[str]:
    """Return the command line of a child that runs this interpreter: `make_python_command("-m", "package.module")`.

    With `-P` the child does not search the folder that it runs in for modules. Without it, `python -m` searches that
    folder first, so that a file `random.py` there, even of another user, would replace the module of that name.
    Every child that is started as Python gets its command line here and its variables from `make_child_environment`.
    """
    return [sys.executable, "-P", *arguments]


def make_child_environment(*extra_env: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables of a child: those of this process, then each of `extra_env`.

    `PYTHONSAFEPATH` does for the children of the child what `-P` does for itself. An empty entry of `PYTHONPATH`, as
    in `/opt/mine:$PYTHONPATH`, would stand for the working folder, and is left out.
    """
    variables = dict(os.environ)
    for mapping in extra_env:
        variables.update(mapping)
    if SEARCH_PATH in variables:
        folders = variables[SEARCH_PATH].split(os.pathsep)
        variables[SEARCH_PATH] = os.pathsep.join(filter(None, folders))
    variables[SAFE_PATH] = "1"
    return variables


def isolate_children_from_working_folder() -> None:
    """Have every Python child that this process starts from now on ignore modules in the working folder."""
    os.environ.update(make_child_environment())


def set_parent_death_signal(parent_pid: int | None = None) -> None:
    """Have the kernel kill this process the moment its parent dies, however it dies.

    Args:
        parent_pid: Process id of the parent, as the parent has passed it on. If that process has ended already, this
            process exits at once. None omits this check.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if parent_pid is not None and os.getppid() != parent_pid:
        sys.exit(1)


def list_stop_signals() -> tuple[signal.Signals, ...]:
    """Return the stop signals that this program is to handle: all, but for a closed terminal under `nohup`."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return tuple(number for number in STOP_SIGNALS if not (ignored and number == signal.SIGHUP))


def accept_interrupts() -> None:
    """Receive stop signals from now on. Children start with these signals blocked, until they can handle them."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)


def restart_process() -> NoReturn:
    """Become the same program again, in the same process: with its parent, its arguments and what it has inherited.

    A stop that comes meanwhile waits until the program can handle it. Close everything before.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, sys.orig_argv)


def call_on_stop_signals(stop: Callable[[], None]) -> None:
    """Call a function on SIGTERM, on SIGINT and when the terminal is closed, instead of ending the process at once.

    While the program ends, these signals are ignored. Otherwise a late signal would replace its exit code, because
    Python restores the default handlers before it has ended.
    """

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop()

    def ignore_late_signals() -> None:
        for number in numbers:
            if signal.getsignal(number) is handle:
                signal.signal(number, signal.SIG_IGN)

    numbers = list_stop_signals()
    for number in numbers:
        signal.signal(number, handle)
    atexit.register(ignore_late_signals)
    accept_interrupts()


@contextlib.contextmanager
def raise_on_stop_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt in the main thread at the first stop signal: Ctrl-C, SIGTERM or a closed terminal.

    `with` blocks can then end their workers and remove their files. A second signal ends the process at once. The
    previous handlers are restored at the end of the context.
    """

    def handle(_number: int, _frame: FrameType | None) -> None:
        for number in previous_handlers:
            # A closed terminal sends SIGHUP twice, from the kernel and from the shell: the second one is ignored.
            signal.signal(number, signal.SIG_IGN if number == signal.SIGHUP else signal.SIG_DFL)
        raise KeyboardInterrupt

    previous_handlers = {number: signal.getsignal(number) for number in list_stop_signals()}
    for number in previous_handlers:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def make_collections_rare() -> None:
    """Make garbage collections rare. A program calls this before its imports, of which nothing is ever garbage.

    Otherwise the collector visits the new classes and functions again and again: a tenth of the processor time that a
    run of one second takes.
    """
    gc.set_threshold(50_000, 10, 10)


def tune_garbage_collector() -> None:
    """Keep the garbage collector out of the loop: freeze all current objects, and make collections rare."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 50, 1000)


def enter_realtime(priority: int) -> list[str]:
    """Apply all real-time measures to a process in the control loop. Call it before a session is opened.

    Best effort: measures that the system refuses are printed to stderr, and returned as short reasons.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    results = [set_realtime_priority(priority), lock_memory()]
    refused = [reason for reason in results if reason is not None]
    for reason in refused:
        print_stderr(f"real time: {reason}")
    return refused


def set_realtime_priority(priority: int) -> str | None:
    """Ask the kernel to run this process, and the threads that it will start, before ordinary ones.

    Returns why it was refused, or None.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return f"no real-time priority: {error.strerror}; see `ulimit -r`"
    return None


def drop_priority_after(max_busy_s: float) -> None:
    """Drop the real-time priority of this process once it has computed for so long without a pause that it must hang.

    A busy thread with real-time priority starves ordinary processes, until the kernel throttles all real-time
    processes for some 50 ms.
    """

    def drop_priority(_number: int, _frame: FrameType | None) -> None:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        print_stderr(
            f"real time: priority dropped after computing for {max_busy_s * 1e3:.0f} ms without a pause"
        )

    signal.signal(signal.SIGXCPU, drop_priority)
    _, hard_limit_us = resource.getrlimit(resource.RLIMIT_RTTIME)
    resource.setrlimit(resource.RLIMIT_RTTIME, (round(max_busy_s * 1e6), hard_limit_us))


def lock_memory() -> str | None:
    """Lock all current and future pages of this process into memory. Returns why it was refused, or None.

    Pages are locked as they are first touched, so that the unused part of each thread's stack costs nothing. Under a
    limit nothing is locked: the first allocation beyond it would fail in the middle of a run.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and not _has_capability(CAP_IPC_LOCK):
        return f"memory not locked: the limit is {limit // 1024} KiB, it must be unlimited; see `ulimit -l`"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) != 0:
        return f"memory not locked: {os.strerror(ctypes.get_errno())}"
    return None


def limit_memory() -> None:
    """Let this process allocate no more than the computer has available now: beyond that, an allocation fails.

    Otherwise code that allocates without end makes the whole computer swap, until the kernel ends some process. A
    lower limit, as of `ulimit -d`, stays.
    """
    allowed = max(read_available_memory(), MIN_MEMORY_LIMIT)
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if soft == resource.RLIM_INFINITY or soft > allowed:
        resource.setrlimit(resource.RLIMIT_DATA, (allowed, hard))


def read_available_memory() -> int:
    """Return how many bytes the kernel could give to programs without swapping."""
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    raise OSError("/proc/meminfo has no MemAvailable")


def raise_open_file_limit(max_files: int) -> None:
    """Raise this process's limit of open files and connections, as far as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = max_files
    if hard != resource.RLIM_INFINITY:
        allowed = min(max_files, hard)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))


def step_wall_clock(by_s: float) -> None:
    """Set the computer's clock forward or back. Raises RefusedError without CAP_SYS_TIME."""
    try:
        time.clock_settime(time.CLOCK_REALTIME, time.time() + by_s)
    except PermissionError as error:
        raise RefusedError(
            "the wall clock cannot be stepped: that needs CAP_SYS_TIME; run as root, or omit step:clock",
            code="machine/not-permitted",
        ) from error


def _has_capability(number: int) -> bool:
    """Return whether this process has a capability of the Linux kernel, such as CAP_IPC_LOCK."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    for line in status.splitlines():
        if line.startswith("CapEff:"):
            effective = int(line.split()[1], 16)
            return bool(effective >> number & 1)
    return False
