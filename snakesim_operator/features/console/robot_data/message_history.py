"""The messages of a recording by time. They are kept as bytes, and decoded when they are shown."""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.custom_sample import find_message_type
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.features.console.robot_data.snapshot import MessageStream
from snakesim_operator.recording.message import RecordedMessage

IMAGE_ROWS = (keys.DEPTH_ALL, keys.COLOR_ALL)

# Rows of the key space whose messages are kept, because the rows of a run's record do not have them.
KEPT_ROWS = frozenset(
    {keys.STATUS, keys.POWER, keys.IMU, keys.PARAMETERS_IN_FORCE, keys.CUSTOM_ALL, *IMAGE_ROWS}
)

# Rows of which only the times are kept, to show their rates and ages.
TIMED_ROWS = frozenset(
    {
        keys.CLOCK,
        keys.JOINTS,
        keys.POSE,
        keys.CONTACTS,
        keys.APPLIED,
        keys.WORLD,
        keys.TRAJECTORY,
        keys.CONTROL_STATE,
    }
)
LATCHED_KEYS = (keys.STATUS, keys.PARAMETERS_IN_FORCE)  # published on change, so they have no rate
MAX_IMAGE_BYTES = 256_000_000  # of all images together; beyond this, every second image is dropped
MAX_DECODED = 256  # messages that stay decoded
RATE_PERIOD_S = 1.0


@dataclass
class _KeyMessages:
    """The messages of one key, in the order of the file."""

    times_s: list[float] = field(default_factory=list[float])
    # Empty for a key of TIMED_ROWS.
    kept: list[RecordedMessage] = field(default_factory=list[RecordedMessage])


class MessageHistory:
    """Every message of a recording that the console shows."""

    def __init__(self) -> None:
        self._messages: dict[str, _KeyMessages] = {}  # by key
        self._image_bytes = 0
        self.image_decimation = 1  # one of so many images is kept
        self.robot: RobotDescription | None = None  # describes custom sensors
        self._decode_cached = lru_cache(MAX_DECODED)(self._decode)

    def add(self, message: RecordedMessage) -> None:
        """Add the next message of the recording, if the console shows its key."""
        row = keys.find_row_key(message.key)
        if row not in KEPT_ROWS and row not in TIMED_ROWS:
            return
        messages = self._messages.setdefault(message.key, _KeyMessages())
        previous_s = messages.times_s[-1] if messages.times_s else 0.0
        # Times are sorted, to be searched.
        messages.times_s.append(max(message.robot_time_ns * 1e-9, previous_s))
        if row in KEPT_ROWS:
            messages.kept.append(message)
        if row in IMAGE_ROWS:
            self._image_bytes += len(message.payload)
            if self._image_bytes > MAX_IMAGE_BYTES:
                self._drop_every_second_image()

    def _drop_every_second_image(self) -> None:
        self.image_decimation *= 2
        for key, messages in self._messages.items():
            if keys.find_row_key(key) in IMAGE_ROWS:
                messages.kept = messages.kept[::2]
                messages.times_s = messages.times_s[::2]
        self._image_bytes //= 2

    def find_newest(self, key: str, time_s: float) -> Any:
        """Return the newest message of a key at a time; None if there is none, or it cannot be decoded."""
        messages = self._messages.get(key)
        if messages is None:
            return None
        index = bisect_right(messages.times_s, time_s) - 1
        if index < 0:
            return None
        return self._decode_cached(key, index)

    def find_all_newest(self, row: str, time_s: float) -> dict[str, Any]:
        """Return the newest message at a time of each key in a row of the key space, by key."""
        newest: dict[str, Any] = {}
        for key in sorted(self._messages):
            if keys.find_row_key(key) != row:
                continue
            message = self.find_newest(key, time_s)
            if message is not None:
                newest[key] = message
        return newest

    def iterate_messages(self, key: str) -> Iterator[tuple[float, Any]]:
        """Yield the time in s and the message, for each message of a key that can be decoded."""
        messages = self._messages.get(key)
        if messages is None:
            return
        for index, time_s in enumerate(messages.times_s):
            message = self._decode(key, index)
            if message is not None:
                yield time_s, message

    def measure_streams(self, time_s: float) -> dict[str, MessageStream]:
        """Return the rate over the last second and the age of each key at a time, by key."""
        streams: dict[str, MessageStream] = {}
        for key, messages in sorted(self._messages.items()):
            count = bisect_right(messages.times_s, time_s)
            if count == 0 or keys.find_row_key(key) in LATCHED_KEYS:
                continue
            recent_count = count - bisect_right(messages.times_s, time_s - RATE_PERIOD_S)
            age_s = time_s - messages.times_s[count - 1]
            streams[key] = MessageStream(recent_count / RATE_PERIOD_S, age_s)
        return streams

    def _decode(self, key: str, index: int) -> Any:
        """Return a message of a key; None if its type is not known, or it cannot be decoded."""
        kept = self._messages[key].kept[index]
        message_type = find_message_type(key, self.robot)
        if message_type is None:
            return None
        try:
            return MessageDecoder(message_type).decode(kept.payload, kept.encoding)
        except WireError:
            return None
