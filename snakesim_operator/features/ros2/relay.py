"""Bounds the rate at which samples of the robot reach ROS, and converts robot time to the time of the ROS nodes."""

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Generic, NamedTuple

from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageT
from snakesim_hal.wire.messages import Imu, Message

# A delayed clock message must not move the offset, so several seconds of clocks count.
MAX_CLOCK_OFFSETS = 256
MAX_SAMPLES = 4  # some malformed samples must not displace the newest valid one


class ImuMeasurement(NamedTuple):
    """What one IMU has measured."""

    sample: Imu
    index_in_sample: int  # of the IMU in the lists of the sample


def _has_always_subscriber() -> bool:
    return True


class TopicRelay(ABC, Generic[MessageT]):
    """Forwards samples of one key in every n-th cycle of the bridge, while ROS nodes want them.

    The relay subscribes to the key only while a subscriber needs the samples: an image that no ROS node reads does not
    travel through the robot's network.
    """

    depth: int | None = MAX_SAMPLES  # samples that are kept until the next poll; None for all

    def __init__(
        self,
        session: Session,
        key: str,
        message_type: type[MessageT],
        every_cycles: int = 1,
        has_subscriber: Callable[[], bool] = _has_always_subscriber,
    ) -> None:
        """Prepare the relay. It subscribes in its first poll.

        Args:
            session: Session on the robot's network.
            key: Key of the samples.
            message_type: Message type of the samples.
            every_cycles: Number of bridge cycles from one forwarded sample to the next.
            has_subscriber: Returns whether a ROS node subscribes to the result now.
        """
        self._session = session
        self._key = key
        self._message_type = message_type
        self._every_cycles = every_cycles
        self._has_subscriber = has_subscriber
        # None while no subscriber needs the samples.
        self._reader: SampleReader[MessageT] | None = None

    @abstractmethod
    def forward_new_samples(
        self, reader: SampleReader[MessageT], is_valid: Callable[[Message], bool]
    ) -> None:
        """Forward what has arrived since the last poll, at most once for each topic.

        Args:
            reader: Reader of the samples that have arrived.
            is_valid: Returns whether a sample fits the robot; other samples are skipped.
        """

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
            self._reader = self._session.declare_reader(
                self._key, self._message_type, depth=self.depth
            )
        self.forward_new_samples(self._reader, is_valid)

    def _unsubscribe(self) -> None:
        if self._reader is not None:
            self._session.close_reader(self._reader)
            self._reader = None


class NewestRelay(TopicRelay[MessageT]):
    """Forwards the newest sample since the last poll."""

    def __init__(
        self,
        session: Session,
        key: str,
        message_type: type[MessageT],
        every_cycles: int,
        forward: Callable[[MessageT], None],
        has_subscriber: Callable[[], bool] = _has_always_subscriber,
    ) -> None:
        """Prepare the relay, as `TopicRelay` does; `forward` is called with each forwarded sample."""
        super().__init__(session, key, message_type, every_cycles, has_subscriber)
        self._forward = forward

    def forward_new_samples(
        self, reader: SampleReader[MessageT], is_valid: Callable[[Message], bool]
    ) -> None:
        newest = reader.pop_newest(is_valid)
        if newest is not None:
            self._forward(newest)


class ImuRelay(TopicRelay[Imu]):
    """Forwards the newest measurement of every IMU since the last poll.

    A sample holds only those IMUs that have new measurements, so all samples count.
    """

    depth = None

    def __init__(
        self, session: Session, forward: Callable[[dict[int, ImuMeasurement]], None]
    ) -> None:
        """Prepare the relay; `forward` is called with the newest measurement of each IMU by the index of its link."""
        super().__init__(session, keys.IMU, Imu)
        self._forward = forward

    def forward_new_samples(
        self, reader: SampleReader[Imu], is_valid: Callable[[Message], bool]
    ) -> None:
        newest: dict[int, ImuMeasurement] = {}
        for sample in reader.drain():
            if is_valid(sample):
                newest |= {
                    link: ImuMeasurement(sample, entry) for entry, link in enumerate(sample.link)
                }
        if newest:
            self._forward(newest)


class RosTime:
    """Converts robot time to the time that ROS nodes use: robot time itself, or wall-clock time.

    With wall-clock time, each arriving robot clock gives one offset: clock offset plus network latency. The smallest
    of the last MAX_CLOCK_OFFSETS offsets belongs to the fastest message and is used for all timestamps.
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
