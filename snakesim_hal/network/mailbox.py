"""A queue between Zenoh's threads and one that waits with a deadline.

`queue.SimpleQueue.get(timeout=...)` of CPython 3.11 may wait for ever: when the thread is held up for longer than the
timeout between its two looks at the clock, what is left is negative, and the lock takes that for no limit at all. On a
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

    It may have lanes: an item of a lower lane is taken before all of a higher one. A lane that is full forgets its
    oldest item.
    """

    def __init__(self, limits: Sequence[int | None] = (None,)) -> None:
        """limits: how many items each lane keeps; None: any number."""
        self._lanes: list[deque[ItemT]] = [deque(maxlen=limit) for limit in limits]
        self._bell = threading.Lock()  # held: nothing new since the last look
        self._bell.acquire()

    def put(self, item: ItemT, lane: int = 0) -> None:
        """Add an item; never waits."""
        self._lanes[lane].append(item)
        with contextlib.suppress(RuntimeError):  # it has rung already
            self._bell.release()

    def full(self, lane: int = 0) -> bool:
        """Whether one more item would push out the oldest."""
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

    def get_nowait(self) -> ItemT:
        """The oldest item of the lowest lane, if there is one."""
        return self.get(timeout=0.0)

    def empty(self) -> bool:
        """Whether nothing is there now."""
        return not any(self._lanes)

    def qsize(self) -> int:
        """How much is there now."""
        return sum(map(len, self._lanes))
