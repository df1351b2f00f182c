"""When the state of each recent tick went out, so that the age of an answer to it can be told."""

from collections import deque

KEPT = 4096
LONG_AGO_NS = -(2**60)


class PublishTimes:
    """Safety time and monotonic time of publishing, by tick; ticks come in order without gaps."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, int, int]] = deque(maxlen=KEPT)  # tick, safety ns, monotonic ns

    @property
    def last_tick(self) -> int | None:
        """The tick that was published last."""
        return self._rows[-1][0] if self._rows else None

    def put(self, tick: int, safety_ns: int, monotonic_ns: int) -> None:
        """A tick was published, perhaps once more."""
        if self.last_tick == tick:
            self._rows.pop()
        self._rows.append((tick, safety_ns, monotonic_ns))

    def of(self, tick: int) -> tuple[int, int]:
        """Safety and monotonic time of a tick; long ago when it is not kept any more, or never was published."""
        back = -1 if self.last_tick is None else self.last_tick - tick
        if 0 <= back < len(self._rows):
            found = self._rows[-1 - back]
            if found[0] == tick:
                return found[1], found[2]
        return LONG_AGO_NS, LONG_AGO_NS
