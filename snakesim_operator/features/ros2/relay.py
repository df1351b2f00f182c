"""The newest sample of a key, at a bounded rate; and what time it is in ROS."""

import time
from collections import deque
from collections.abc import Callable
from typing import Generic

from snakesim_hal.network.session import Reader, Session
from snakesim_hal.wire.codec import MessageT
from snakesim_hal.wire.messages import Message

WALL_SAMPLES = 256  # of the offset between robot time and the wall clock
DEPTH = 4  # samples kept of a key: a few of noise do not displace the valid one


class Relay(Generic[MessageT]):
    """The newest sample of one key, passed on every so many turns of the bridge, while it is wanted."""

    def __init__(
        self,
        session: Session,
        key: str,
        message: type[MessageT],
        every: int,
        pass_on: Callable[[MessageT], None],
        wanted: Callable[[], bool] = lambda: True,
        *,
        each: bool = False,
    ) -> None:
        """each: all samples since the last turn, of a key whose samples complete one another."""
        self._each = each
        self._session, self._key, self._message = session, key, message
        self._every = every
        self._pass_on, self._wanted = pass_on, wanted
        self._reader: Reader[MessageT] | None = None

    def turn(self, number: int, fits: Callable[[Message], bool]) -> None:
        """Pass on what has arrived, if it is due. number: of the bridge's turn."""
        if number % self._every:
            return
        if not self._wanted():
            if self._reader is not None:
                self._session.stop_reading(self._reader)
                self._reader = None
            return
        if self._reader is None:
            depth = None if self._each else DEPTH
            self._reader = self._session.reader(self._key, self._message, depth=depth)
        if self._each:
            for sample in filter(fits, self._reader.drain()):
                self._pass_on(sample)
        elif (newest := self._reader.newest(fits)) is not None:
            self._pass_on(newest)


class RosTime:
    """Robot time as the time of the ROS side."""

    def __init__(self, *, wall_time: bool) -> None:
        self.wall_time = wall_time
        self._offsets_ns: deque[int] = deque(maxlen=WALL_SAMPLES)

    def heard(self, clock_ns: int) -> None:
        """A robot clock has just arrived; the least offset of late is that of the quickest one."""
        self._offsets_ns.append(time.time_ns() - clock_ns)

    def start_over(self) -> None:
        """The robot's time restarts."""
        self._offsets_ns.clear()

    def of(self, robot_ns: int) -> int:
        """The stamp in ROS."""
        return robot_ns + min(self._offsets_ns, default=0) if self.wall_time else robot_ns
