"""The samples of one key by tick, as a client keeps them, and the filter for messages of another robot.

Only the client's own thread uses both: a feed fetches what has arrived when the client calls it.
"""

from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Generic

from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.streams import Reader
from snakesim_hal.wire.codec import MessageT
from snakesim_hal.wire.messages import Description, Message

KEPT_PER_KEY = 32  # samples
NO_TICK = -1  # of messages without a tick, such as an intent: only the newest counts


class Feed(Generic[MessageT]):
    """The newest samples of one key, by tick."""

    def __init__(
        self, reader: Reader[MessageT], key: str, fits: Callable[[Message], bool] = lambda _message: True
    ) -> None:
        """Keep the samples of a reader.

        Args:
            reader: of the key.
            key: the key itself.
            fits: returns whether a message fits the robot; others are dropped.
        """
        self._reader = reader
        self._fits = fits
        self._kept: OrderedDict[int, MessageT] = OrderedDict()
        self.key = key

    def store_arrived(self, *, newest_only: bool = False) -> None:
        """Store newly arrived samples.

        Args:
            newest_only: store the newest sample alone, in place of all earlier ones.
        """
        if newest_only:
            newest = self._reader.newest(self._fits)
            if newest is not None:
                self._kept.clear()
                self._store(newest)
            return
        for message in self._reader.drain():
            if self._fits(message):
                self._store(message)
        while len(self._kept) > KEPT_PER_KEY:
            self._kept.popitem(last=False)

    def _store(self, message: MessageT) -> None:
        tick: int = getattr(message, "tick", NO_TICK)
        self._kept[tick] = message
        self._kept.move_to_end(tick)

    def clear(self) -> None:
        """Drop all samples, because the HAL host has restarted."""
        self._kept.clear()

    def newest(self) -> MessageT | None:
        """Return the sample that arrived last."""
        if not self._kept:
            return None
        return self._kept[next(reversed(self._kept))]

    def at(self, tick: int) -> MessageT | None:
        """Return the sample of exactly this tick."""
        return self._kept.get(tick)


class RobotFilter:
    """Accepts the messages that fit a robot, and counts the others.

    It is an object of its own because a client's feeds hold it: if they held the client instead, the client would
    never be released.
    """

    def __init__(self, rejected: Counter[str]) -> None:
        """Count rejected messages into `rejected`, by reason."""
        self._rejected = rejected
        self.robot: Description | None = None  # None: not known yet; every message is accepted

    def accepts(self, message: Message) -> bool:
        """Return whether a message fits the robot, as far as that is known."""
        if self.robot is None:
            return True
        error = find_mismatch(message, self.robot)
        if error is None:
            return True
        self._rejected[error.reason] += 1
        return False
