"""A queue from Zenoh's threads to one that waits with a deadline.

`queue.SimpleQueue.get(timeout=...)` of CPython 3.11 may wait for ever: if the thread is delayed for longer than the
timeout between its two readings of the clock, the remaining time is negative, which the lock takes for no limit. On a
busy machine that stopped a host for good: it waited for a command, and the controller for its clock.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Sequence
from queue import Empty
from typing import Generic, TypeVar

ItemT = TypeVar("ItemT")


class Mailbox(Generic[ItemT]):
    """Any number of threads put, one takes. Raises queue.Empty, as the queues of the standard library do.

    It may have lanes: items of a lower lane are taken before those of a higher one. A full lane drops its oldest item.
    """

    def __init__(self, limits: Sequence[int | None] = (None,)) -> None:
        """limits: how many items each lane keeps; None: any number."""
        self._lanes: list[deque[ItemT]] = [deque(maxlen=limit) for limit in limits]
        self._bell = threading.Lock()  # held: nothing new since the last look
        self._bell.acquire()

    def put(self, item: ItemT, lane: int = 0) -> None:
        """Add an item; never waits."""
        self._lanes[lane].append(item)
        if self._bell.locked():
            with contextlib.suppress(RuntimeError):  # another thread has just released it
                self._bell.release()

    def full(self, lane: int = 0) -> bool:
        """Whether one more item would displace the oldest."""
        return len(self._lanes[lane]) == self._lanes[lane].maxlen

    def get(self, timeout: float | None = None) -> ItemT:
        """The oldest item of the lowest lane; waits for one, at most `timeout` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            for lane in self._lanes:
                if lane:
                    return lane.popleft()
            left_s = -1.0 if deadline is None else deadline - time.monotonic()
            if deadline is not None and left_s <= 0.0:
                raise Empty
            self._bell.acquire(timeout=left_s)

    def wait(self, timeout: float) -> None:
        """Until there is an item, at most `timeout` seconds; takes none."""
        deadline = time.monotonic() + timeout
        while self.empty() and (left_s := deadline - time.monotonic()) > 0.0:
            self._bell.acquire(timeout=left_s)

    def get_nowait(self) -> ItemT:
        """The oldest item of the lowest lane, if there is one."""
        return self.get(timeout=0.0)

    def empty(self) -> bool:
        """Whether there are no items now."""
        return not any(self._lanes)

    def qsize(self) -> int:
        """Number of items now."""
        return sum(map(len, self._lanes))
