"""Measures how long processes wait for a processor, to distinguish a slow computer from a silent service.

The kernel counts how long each thread was ready to run and did not run; it adds a wait when the wait ends. A wait that
still lasts shows in a thread that is ready to run and whose counters do not change. The waits of all threads of a
process are added, because its threads wait for one another.
"""

import contextlib
import os
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

HISTORY_S = 1.0
# A process that waits for more than this fraction of a lease, within about two leases, cannot answer in time.
MIN_LONG_WAIT_FRACTION = 0.5


class ThreadUsage(NamedTuple):
    """The kernel's counters of one thread."""

    ran_s: float
    waited_s: float
    ready: bool  # ready to run, or running


class WaitSample(NamedTuple):
    """How long each process had waited for a processor, up to one point in time."""

    time_s: float
    waited_s: dict[str, float]  # by process name


class LongWait(NamedTuple):
    """A process that waited too long for a processor."""

    name: str
    waited_s: float
    window_s: float  # the duration in which it waited so long


def read_usages(pid: int) -> dict[int, ThreadUsage]:
    """Return the counters of each thread of a process, by thread id; empty when the kernel does not provide them."""
    usages: dict[int, ThreadUsage] = {}
    with contextlib.suppress(OSError):
        for task in os.scandir(f"/proc/{pid}/task"):
            with contextlib.suppress(OSError, ValueError, IndexError):
                ran_ns, waited_ns, *_ = _read_file(f"{task.path}/schedstat").split()
                state = _read_file(f"{task.path}/stat").rpartition(b")")[2].split()[0]
                usages[int(task.name)] = ThreadUsage(
                    int(ran_ns) * 1e-9, int(waited_ns) * 1e-9, state == b"R"
                )
    return usages


def _read_file(path: str) -> bytes:
    """Return the content of a small file of the kernel."""
    # A run reads some 80 files 20 times a second. With `pathlib` that takes a tenth of a slow core.
    with open(path, "rb", buffering=0) as file:  # noqa: PTH123
        return file.read()


class ProcessorWaits:
    """Tracks how long some processes waited for a processor in the last second."""

    def __init__(
        self,
        lease_s: float,
        read: Callable[[int], Mapping[int, ThreadUsage]] = read_usages,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare to sample.

        Args:
            lease_s: Duration of the lease in s; a wait of about that duration ends the run.
            read: Reads the counters of the threads of a process, by its process id.
            clock: Monotonic clock in s.
        """
        self._lease_s = lease_s
        self._read = read
        self._clock = clock
        # Of each thread: its usage, and when that was new.
        self._last_change: dict[int, tuple[ThreadUsage, float]] = {}
        self._samples: deque[WaitSample] = deque()

    def take_sample(self, pids: Mapping[str, int]) -> None:
        """Sample the counters of processes, given as process ids by name. Call this several times per lease."""
        now_s = self._clock()
        usages = {name: self._read(pid) for name, pid in pids.items()}
        waited_s: dict[str, float] = {}
        for name, threads in usages.items():
            waited_s[name] = sum(
                self._update_waited_s(thread, usage, now_s) for thread, usage in threads.items()
            )
        self._samples.append(WaitSample(now_s, waited_s))
        while len(self._samples) > 2 and now_s - self._samples[1].time_s > HISTORY_S:
            self._samples.popleft()

    def find_longest(self) -> LongWait | None:
        """Find the process that waited for the largest fraction of a window; None if no process waited too long.

        A window begins at a sample and ends at the first sample at least one lease later.
        """
        longest: LongWait | None = None
        samples = list(self._samples)
        for index, first in enumerate(samples):
            last = self._find_sample_after_lease(first, samples[index + 1 :])
            if last is None:
                break
            for wait in self._find_long_waits(first, last):
                if (
                    longest is None
                    or wait.waited_s / wait.window_s > longest.waited_s / longest.window_s
                ):
                    longest = wait
        return longest

    def _find_sample_after_lease(
        self, first: WaitSample, later: list[WaitSample]
    ) -> WaitSample | None:
        return next(
            (sample for sample in later if sample.time_s - first.time_s >= self._lease_s), None
        )

    def _find_long_waits(self, first: WaitSample, last: WaitSample) -> list[LongWait]:
        """Return the processes that waited too long between two samples."""
        window_s = last.time_s - first.time_s
        max_wait_s = MIN_LONG_WAIT_FRACTION * max(self._lease_s, 0.5 * window_s)
        waits: list[LongWait] = []
        for name, end_s in last.waited_s.items():
            begin_s = first.waited_s.get(name, end_s)
            waited_s = min(end_s - begin_s, window_s)
            if waited_s > max_wait_s:
                waits.append(LongWait(name, waited_s, window_s))
        return waits

    def _update_waited_s(self, thread: int, usage: ThreadUsage, now_s: float) -> float:
        """Return how long a thread has waited so far in s, including a wait that still lasts."""
        last_usage, since_s = self._last_change.get(thread, (usage, now_s))
        if usage != last_usage or not usage.ready:
            since_s = now_s
        self._last_change[thread] = usage, since_s
        return usage.waited_s + now_s - since_s
