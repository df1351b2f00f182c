"""Writes one MCAP file: every message as it was on the wire, with its schema, in the order of arrival.

A channel is a key. Its messages are the payloads without change (encoding `msgpack`), its schema is the published JSON
Schema, its metadata has the encoding on the wire. `log_time` is robot time, `publish_time` is the wall clock at the
recorder, `sequence` counts the arrivals at a key. A chunk is written at least every FLUSH_S, so that a recorder that
is killed loses no more than that.
"""

import json
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import msgspec

from snakesim_hal.model.files import SCHEMAS
from snakesim_hal.network.streams import Arrival
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_hal.wire.messages import Description
from snakesim_operator.recording.disk import GrowingFile
from snakesim_operator.recording.mcap_file import McapFile
from snakesim_operator.recording.robot_time import MessageClock
from snakesim_operator.recording.shown_messages import Show, ShownMessages
from snakesim_operator.recording.stamps import Stamps, mark_stamps, order_times

FLUSH_S = 0.5
MAX_EARLY_SAMPLES = 1000  # of custom sensors before the description; further ones get no schema of their own
MAX_ENCODING_NAME = 200  # characters; it comes from the network
ABOUT = "snakesim"  # the name of the metadata record
COPIED = "lacked_before_copy"  # entry of that record: what the recording lacked that this one was copied from


class RecordingWriter:
    """A file that is being written. A full disk ends it (see `failure`), and raises nothing."""

    def __init__(
        self, path: Path, shown_as: str | None = None, show: Show | None = None, stamps: Stamps = "robot"
    ) -> None:
        """Create an MCAP file for a robot's messages, and write its beginning.

        Args:
            path: The new file.
            shown_as: The robot's name in topics for viewers; None: record only the messages as on the wire.
            show: Gets each message that is made for viewers.
            stamps: The clock of the log times.

        Raises:
            OSError: The file cannot be created; FileExistsError if it exists.
        """
        self.path = path
        self._stamps: Stamps = stamps
        self.failure = ""  # why nothing is written any more
        self.time = MessageClock()
        self._wall_offset_ns = time.time_ns() - time.monotonic_ns()  # wall clock minus monotonic clock

        # The file.
        self._file = GrowingFile(path)
        self._mcap = McapFile(self._file)
        self._channels: dict[str, int] = {}  # channel numbers, by key
        self._schemas: dict[str, int] = {}  # schema numbers, by the schema's name or text
        self._next_flush_s = 0.0

        # The robot's messages.
        self.counts: Counter[str] = Counter()  # messages written, by key
        self._custom_types: dict[str, CustomMessage] = {}  # messages of custom sensors, by key
        self._early_samples: list[Arrival] | None = []  # of custom sensors; None once the description is known

        # Messages made for viewers.
        self._shown: ShownMessages | None = None
        if shown_as is not None:
            self._shown = ShownMessages(self._mcap, shown_as, stamps, show)

        self.flush()

    def write_arrival(self, arrival: Arrival) -> None:
        """Write one message, unless its key is not in the key space.

        A custom sensor's sample waits for the robot's description, which has its schema.
        """
        if self.failure:
            return
        early = self._early_samples
        if early is not None and keys.find_row_key(arrival.key) == keys.CUSTOM_ALL and len(early) < MAX_EARLY_SAMPLES:
            early.append(arrival)
            return
        self._write(arrival)
        if arrival.key == keys.DESCRIPTION:
            self._write_early_samples()

    def flush_when_due(self) -> None:
        """Give the waiting messages to the disk, if the last time is FLUSH_S ago."""
        if not self.failure and time.monotonic() >= self._next_flush_s:
            self.flush()

    def flush(self) -> None:
        """Give the waiting messages to the disk."""
        self._next_flush_s = time.monotonic() + FLUSH_S
        try:
            self._mcap.flush()
        except OSError as error:
            self._set_failure(error)

    def close(self, about: dict[str, object]) -> None:
        """Write metadata and index, and close the file. about: metadata of the recording itself, stored as JSON."""
        self._write_early_samples()
        if not self.failure:
            self._mcap.add_metadata(ABOUT, {name: json.dumps(value) for name, value in about.items()})
            try:
                self._mcap.finish()
            except OSError as error:
                self._set_failure(error)
        self._file.close()

    def _set_failure(self, error: OSError) -> None:
        self.failure = f"{self.path}: {error.strerror or error}"

    def _write_early_samples(self) -> None:
        early = self._early_samples or []
        self._early_samples = None
        for arrival in early:
            self._write(arrival)

    def _write(self, arrival: Arrival) -> None:
        """Write one message, and what is made of it for viewers."""
        if arrival.key == keys.DESCRIPTION:
            with suppress(*UNDECODABLE):
                self._custom_types = find_custom_messages(msgspec.msgpack.decode(arrival.payload, type=Description))
        channel = self._channels.get(arrival.key)
        if channel is None:
            channel = self._open_channel(arrival)
        if channel is None:
            return
        robot_ns = self.time.date(arrival.key, arrival.payload)
        wall_ns = arrival.monotonic_ns + self._wall_offset_ns
        log_ns, publish_ns = order_times(robot_ns, wall_ns, self._stamps)
        self.counts[arrival.key] += 1
        self._mcap.add(channel, log_ns, publish_ns, self.counts[arrival.key], arrival.payload)
        if self._shown is not None:
            self._shown.write(arrival.key, arrival.payload, log_ns, publish_ns)

    def _open_channel(self, arrival: Arrival) -> int | None:
        """Return the number of a new channel for a key, or None if the key is not in the key space."""
        message_type = keys.find_message(arrival.key)
        if message_type is None:
            return None
        custom_type = self._custom_types.get(arrival.key)
        if custom_type is None:
            schema = self._add_published_schema(message_type.__name__)
        else:
            schema = self._add_custom_schema(custom_type)
        metadata = mark_stamps({"encoding": arrival.encoding[:MAX_ENCODING_NAME]}, self._stamps)
        channel = self._mcap.add_channel(arrival.key, "msgpack", schema, metadata)
        self._channels[arrival.key] = channel
        return channel

    def _add_published_schema(self, name: str) -> int:
        """Return the number of a message's published schema; it is added when it is first needed."""
        if name not in self._schemas:
            content = (SCHEMAS / "messages" / f"{name}.json").read_bytes()
            self._schemas[name] = self._mcap.add_schema(f"snakesim.{name}", "jsonschema", content)
        return self._schemas[name]

    def _add_custom_schema(self, custom_type: CustomMessage) -> int:
        """Return the number of a custom message's schema. Its text identifies it: two authors may choose one name."""
        text = custom_type.schema
        if text not in self._schemas:
            name = f"snakesim.custom.{custom_type.message.__name__}"
            self._schemas[text] = self._mcap.add_schema(name, "jsonschema", text.encode())
        return self._schemas[text]
