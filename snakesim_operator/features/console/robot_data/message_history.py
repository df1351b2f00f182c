"""What a recording holds besides a record's rows, by time: kept as bytes, and decoded when it is looked at."""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.own_sample import message_of
from snakesim_operator.features.console.robot_data.snapshot import Stream
from snakesim_operator.recording.message import RecordedMessage

IMAGES = (keys.DEPTH_ALL, keys.COLOUR_ALL)
KEPT = frozenset({keys.STATUS, keys.POWER, keys.IMU, keys.SETTINGS_IN_FORCE, keys.OWN_ALL, *IMAGES})
STREAMS = frozenset(
    {keys.CLOCK, keys.JOINTS, keys.POSE, keys.CONTACTS, keys.APPLIED, keys.WORLD, keys.TRAJECTORY, keys.CONTROL_STATE}
)  # of which rates and ages are shown
MOST_BYTES = 256_000_000  # of images; of more every second one is forgotten
RATE_PERIOD_S = 1.0


@dataclass
class _Messages:
    times_s: list[float] = field(default_factory=list[float])
    kept: list[RecordedMessage] = field(default_factory=list[RecordedMessage])  # of some keys none


class MessageHistory:
    """Every message of a recording, given in the order of the file."""

    def __init__(self) -> None:
        self._by_key: dict[str, _Messages] = {}
        self._image_bytes = 0
        self.thinned = 1  # of so many images one is kept
        self.robot: Description | None = None
        self._decoded = lru_cache(256)(self._decode)

    def take(self, message: RecordedMessage) -> None:
        """One more."""
        row = keys.row_key(message.key)
        if row not in KEPT and row not in STREAMS:
            return
        of_key = self._by_key.setdefault(message.key, _Messages())
        of_key.times_s.append(max(message.time_ns * 1e-9, of_key.times_s[-1] if of_key.times_s else 0.0))
        if row in KEPT:
            of_key.kept.append(message)
        if row in IMAGES:
            self._image_bytes += len(message.payload)
            if self._image_bytes > MOST_BYTES:
                self._thin()

    def _thin(self) -> None:
        self.thinned *= 2
        for key, of_key in self._by_key.items():
            if keys.row_key(key) in IMAGES:
                of_key.kept, of_key.times_s = of_key.kept[::2], of_key.times_s[::2]
        self._image_bytes //= 2

    def newest(self, key: str, time_s: float) -> Any:
        """The message at a key that was the newest then; None: there was none, or nobody can read it."""
        of_key = self._by_key.get(key)
        i = -1 if of_key is None else bisect_right(of_key.times_s, time_s) - 1
        return None if of_key is None or i < 0 else self._decoded(key, i)

    def all_newest(self, row: str, time_s: float) -> dict[str, Any]:
        """By key, of all keys of a line of the key space."""
        found = {key: self.newest(key, time_s) for key in sorted(self._by_key) if keys.row_key(key) == row}
        return {key: message for key, message in found.items() if message is not None}

    def every(self, key: str) -> Iterator[tuple[float, Any]]:
        """All that can be read at a key, with their times."""
        of_key = self._by_key.get(key, _Messages())
        for i, time_s in enumerate(of_key.times_s):
            if (message := self._decode(key, i)) is not None:
                yield time_s, message

    def streams(self, time_s: float) -> dict[str, Stream]:
        """Rate over the last second and age of each key then."""
        found: dict[str, Stream] = {}
        for key, of_key in sorted(self._by_key.items()):
            i = bisect_right(of_key.times_s, time_s)
            if i > 0 and keys.row_key(key) not in (keys.STATUS, keys.SETTINGS_IN_FORCE):
                count = i - bisect_right(of_key.times_s, time_s - RATE_PERIOD_S)
                found[key] = Stream(count / RATE_PERIOD_S, time_s - of_key.times_s[i - 1])
        return found

    def _decode(self, key: str, i: int) -> Any:
        kept, kind = self._by_key[key].kept[i], message_of(key, self.robot)
        if kind is None:
            return None
        try:
            return Decoder(kind).decode(kept.payload, kept.encoding)
        except WireError:
            return None
