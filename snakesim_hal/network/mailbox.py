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
    """A queue into which any thread puts items, and from which one thread takes them.

    It may have lanes: items of a lower lane are taken before those of a higher one. A full lane drops its oldest item.
    """

    def __init__(self, limits: Sequence[int | None] = (None,)) -> None:
        """Create a lane for each limit.

        Args:
            limits: Maximum number of items in each lane, the most urgent lane first. None means any number.
        """
        self._lanes: list[deque[ItemT]] = [deque(maxlen=limit) for limit in limits]
        # Released by `put`, and acquired by the thread that waits for an item.
        self._item_signal = threading.Lock()
        self._item_signal.acquire()

    def put(self, item: ItemT, lane_index: int = 0) -> None:
        """Add an item, from any thread; never waits."""
        self._lanes[lane_index].append(item)
        if self._item_signal.locked():
            with contextlib.suppress(RuntimeError):  # another thread has just released it
                self._item_signal.release()

    def is_full(self, lane_index: int = 0) -> bool:
        """Return whether one more item would displace the oldest of a lane."""
        return len(self._lanes[lane_index]) == self._lanes[lane_index].maxlen

    def get(self, timeout: float | None = None) -> ItemT:
        """Wait for an item if there is none, then remove and return the oldest item of the most urgent lane.

        Args:
            timeout: Maximum time to wait, in seconds. None waits without a limit.

        Raises:
            queue.Empty: No item arrived in time, as in the queues of the standard library.
        """
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            for lane in self._lanes:
                if lane:
                    return lane.popleft()
            if deadline_s is None:
                self._item_signal.acquire()
                continue
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0.0:
                raise Empty
            self._item_signal.acquire(timeout=remaining_s)

    def wait(self, timeout: float) -> None:
        """Wait until there is an item, at most `timeout` seconds, without taking it."""
        deadline_s = time.monotonic() + timeout
        while self.empty() and (remaining_s := deadline_s - time.monotonic()) > 0.0:
            self._item_signal.acquire(timeout=remaining_s)

    def get_nowait(self) -> ItemT:
        """Remove and return an item as `get` does, without waiting. Raises queue.Empty if there is none."""
        return self.get(timeout=0.0)

    def empty(self) -> bool:
        """Return whether there are no items now."""
        return not any(self._lanes)

    def qsize(self) -> int:
        """Return the number of items now."""
        return sum(map(len, self._lanes))
