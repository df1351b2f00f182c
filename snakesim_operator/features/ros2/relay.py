"""Bounds the rate at which samples of the robot reach ROS, and converts robot time to the time of the ROS nodes."""

import time
from collections import deque
from collections.abc import Callable
from typing import Generic

from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Reader
from snakesim_hal.wire.codec import MessageT
from snakesim_hal.wire.messages import Message

MAX_CLOCK_OFFSETS = 256  # a delayed clock message must not move the offset, so several seconds of clocks count
MAX_SAMPLES = 4  # some malformed samples must not displace the newest valid one


def _always() -> bool:
    return True


class Relay(Generic[MessageT]):
    """Forwards samples of one key in every n-th cycle of the bridge, while ROS nodes want them.

    The relay subscribes to the key only while a subscriber needs the samples: an image that no ROS node reads does not
    travel through the robot's network.
    """

    def __init__(
        self,
        session: Session,
        key: str,
        message_type: type[MessageT],
        every_cycles: int,
        forward: Callable[[MessageT], None],
        has_subscriber: Callable[[], bool] = _always,
        *,
        forwards_all: bool = False,
    ) -> None:
        """Prepare the relay. It subscribes in its first poll.

        Args:
            session: Session on the robot's network.
            key: Key of the samples.
            message_type: Their message type.
            every_cycles: Number of bridge cycles from one forwarded sample to the next.
            forward: Receives each forwarded sample.
            has_subscriber: Returns whether a ROS node reads the result at present.
            forwards_all: Forward all samples since the last poll instead of the newest one, for a key whose samples
                complete each other.
        """
        self._session = session
        self._key = key
        self._message_type = message_type
        self._every_cycles = every_cycles
        self._forward = forward
        self._has_subscriber = has_subscriber
        self._forwards_all = forwards_all
        self._reader: Reader[MessageT] | None = None  # None while no subscriber needs the samples

    def poll(self, cycle: int, is_valid: Callable[[Message], bool]) -> None:
        """Forward what has arrived, if the relay is due in this cycle.

        Args:
            cycle: Number of the bridge's cycle.
            is_valid: Returns whether a sample fits the robot; other samples are skipped.
        """
        if cycle % self._every_cycles != 0:
            return
        if not self._has_subscriber():
            self._unsubscribe()
            return
        if self._reader is None:
            self._reader = self._subscribe()
        if self._forwards_all:
            for sample in self._reader.drain():
                if is_valid(sample):
                    self._forward(sample)
        else:
            newest = self._reader.newest(is_valid)
            if newest is not None:
                self._forward(newest)

    def _subscribe(self) -> Reader[MessageT]:
        depth: int | None = MAX_SAMPLES
        if self._forwards_all:
            depth = None
        return self._session.reader(self._key, self._message_type, depth=depth)

    def _unsubscribe(self) -> None:
        if self._reader is not None:
            self._session.stop_reading(self._reader)
            self._reader = None


class RosTime:
    """Converts robot time to the time that ROS nodes use: robot time itself, or wall-clock time.

    With wall-clock time, each arriving robot clock gives one offset: clock offset plus network latency. The smallest
    of the last CLOCK_OFFSETS_KEPT offsets belongs to the fastest message and is used for all timestamps.
    """

    def __init__(self, *, wall_time: bool) -> None:
        self.wall_time = wall_time
        self.newest_robot_ns = 0  # robot time of the newest clock
        self._offsets_ns: deque[int] = deque(maxlen=MAX_CLOCK_OFFSETS)

    def add_clock(self, robot_ns: int) -> None:
        """Take in the robot time of a clock message that has just arrived."""
        self.newest_robot_ns = robot_ns
        self._offsets_ns.append(time.time_ns() - robot_ns)

    def reset(self) -> None:
        """Forget the offsets, because robot time started over."""
        self._offsets_ns.clear()

    def convert(self, robot_ns: int) -> int:
        """Return the ROS timestamp in ns of a robot time in ns."""
        if not self.wall_time:
            return robot_ns
        return robot_ns + min(self._offsets_ns, default=0)
