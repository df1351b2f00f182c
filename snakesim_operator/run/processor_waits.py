"""How long processes wait for a processor: it tells a computer that is too slow from a service that is silent.

The kernel counts how long a thread could have run and did not, each wait as it ends; one that goes on shows in a thread
that is ready to run, and does not. The waits of all threads of a process add up: its threads wait for one another.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

KEPT_S = 1.0
SLOW_SHARE = 0.5  # of a lease: who waits for more of it within about two cannot answer in time


class Usage(NamedTuple):
    """What the kernel tells of a thread."""

    ran_s: float
    waited_s: float
    ready: bool  # to run, or running


def usages(pid: int) -> dict[int, Usage]:
    """Of each thread of a process, so far; empty when the kernel does not tell."""
    found: dict[int, Usage] = {}
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, ValueError, IndexError):
                ran, waited, *_ = (task / "schedstat").read_text().split()
                state = (task / "stat").read_text().rpartition(")")[2].split()[0]
                found[int(task.name)] = Usage(int(ran) * 1e-9, int(waited) * 1e-9, state == "R")
    return found


class ProcessorWaits:
    """Of some processes, over the last second."""

    def __init__(
        self,
        lease_s: float,
        read: Callable[[int], Mapping[int, Usage]] = usages,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """lease_s: a wait of about that long ends the run."""
        self._lease_s, self._read, self._clock = lease_s, read, clock
        self._since: dict[int, tuple[Usage, float]] = {}  # the newest usage of each thread, and when it came to be
        self._seen: deque[tuple[float, dict[str, float]]] = deque()  # time, each process' wait until then

    def look(self, pids: Mapping[str, int]) -> None:
        """Take the present numbers of the processes, by name; call it often."""
        now_s = self._clock()
        now = {name: self._read(pid).items() for name, pid in pids.items()}
        waits = {name: sum(self._waited_s(*thread, now_s) for thread in threads) for name, threads in now.items()}
        self._seen.append((now_s, waits))
        while len(self._seen) > 2 and now_s - self._seen[1][0] > KEPT_S:
            self._seen.popleft()

    def longest(self) -> tuple[str, float, float] | None:
        """Who waited too long, how long, and in which time, in seconds; None: nobody."""
        found: tuple[str, float, float] | None = None
        seen = list(self._seen)
        for at, (began_s, before) in enumerate(seen):
            later = next((one for one in seen[at + 1 :] if one[0] - began_s >= self._lease_s), None)
            if later is None:
                break
            lasted_s = later[0] - began_s
            for name, wait_s in later[1].items():
                waited_s = min(wait_s - before.get(name, wait_s), lasted_s)
                most = waited_s > SLOW_SHARE * max(self._lease_s, 0.5 * lasted_s)
                if most and (found is None or waited_s / lasted_s > found[1] / found[2]):
                    found = name, waited_s, lasted_s
        return found

    def _waited_s(self, thread: int, now: Usage, now_s: float) -> float:
        before, since_s = self._since.get(thread, (now, now_s))
        if now != before or not now.ready:
            since_s = now_s
        self._since[thread] = now, since_s
        return now.waited_s + now_s - since_s
