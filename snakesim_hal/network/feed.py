"""The samples of one key by tick, as a client keeps them, and the filter for messages of another robot.

Only the client's own thread uses both: a feed fetches what has arrived when the client calls it.
"""

from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Generic

from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire.codec import MessageT
from snakesim_hal.wire.messages import Message, RobotDescription

MAX_SAMPLES_PER_KEY = 32  # samples
NO_TICK = -1  # of messages without a tick, such as an intent: only the newest counts


class SampleFeed(Generic[MessageT]):
    """The newest samples of one key, by tick."""

    def __init__(
        self,
        reader: SampleReader[MessageT],
        key: str,
        is_acceptable: Callable[[Message], bool] = lambda _message: True,
    ) -> None:
        """Start without samples.

        Args:
            reader: Reader of the key's samples.
            key: Key of the samples.
            is_acceptable: Function that returns whether a message fits the robot. Other messages are dropped.
        """
        self._reader = reader
        self._is_acceptable = is_acceptable
        self._samples_by_tick: OrderedDict[int, MessageT] = OrderedDict()
        self.key = key

    def store_arrived_samples(self, *, newest_only: bool = False) -> None:
        """Store newly arrived samples.

        Args:
            newest_only: Whether to store only the newest sample, in place of all earlier ones.
        """
        if newest_only:
            newest = self._reader.pop_newest(self._is_acceptable)
            if newest is not None:
                self._samples_by_tick.clear()
                self._store(newest)
            return
        for message in self._reader.drain():
            if self._is_acceptable(message):
                self._store(message)
        while len(self._samples_by_tick) > MAX_SAMPLES_PER_KEY:
            self._samples_by_tick.popitem(last=False)

    def _store(self, message: MessageT) -> None:
        tick: int = getattr(message, "tick", NO_TICK)
        self._samples_by_tick[tick] = message
        self._samples_by_tick.move_to_end(tick)

    def clear(self) -> None:
        """Drop all samples, because the HAL host has restarted."""
        self._samples_by_tick.clear()

    def newest(self) -> MessageT | None:
        """Return the sample that arrived last, or None without any sample."""
        if not self._samples_by_tick:
            return None
        return self._samples_by_tick[next(reversed(self._samples_by_tick))]

    def get_at_tick(self, tick: int) -> MessageT | None:
        """Return the sample of exactly this tick, or None if it is not stored."""
        return self._samples_by_tick.get(tick)


class RobotFilter:
    """Accepts the messages that fit a robot, and counts the others.

    It is an object of its own because a client's feeds hold it: if they held the client instead, the client would
    never be released.
    """

    def __init__(self, rejected: Counter[str]) -> None:
        """Count rejected messages into `rejected`, by reason."""
        self._rejected = rejected
        self.robot: RobotDescription | None = None  # None: not known yet; every message is accepted

    def accepts(self, message: Message) -> bool:
        """Return whether a message fits the robot, as far as that is known."""
        if self.robot is None:
            return True
        error = find_mismatch(message, self.robot)
        if error is None:
            return True
        self._rejected[error.reason] += 1
        return False
