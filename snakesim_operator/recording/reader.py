"""Reads a recording: the messages in the order of the file, also of one that is damaged or was never finished.

Damage does not end the reading: it continues at the next intact chunk. What is lost in between is known from the
messages' sequence numbers, which count up for each key, and from the file's own statistics if it has an end.
"""

import json
import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Header, McapRecord, Message, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.keys import find_row_key
from snakesim_operator.recording.chunks import DamagedError, parse_chunk, parse_record, unpack_chunk
from snakesim_operator.recording.losses import MAX_GAPS, UNKNOWN_KEYS, Losses
from snakesim_operator.recording.mcap_file import PROFILE
from snakesim_operator.recording.mcap_records import (
    CUT,
    READ_OPCODES,
    RawRecord,
    find_next_record,
    read_record,
    read_summary,
)
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.recording.stamps import read_stamps
from snakesim_operator.recording.writer import ABOUT, COPIED

LATEST_NS = 2**62  # 146 years: no robot time is later
NO_SCHEMA = 0  # MCAP's number for a channel without a schema

# A file may unpack to MAX_UNPACKING_RATIO times its size and to FREE_BYTES more; no robot's messages exceed that.
MAX_UNPACKING_RATIO = 100
FREE_BYTES = 32 * 1024 * 1024

# Bounds of the metadata, which comes from the file.
MAX_KEY_LENGTH = 200
MAX_EARLIER_LOSSES = 10
MAX_EARLIER_LENGTH = 500


@dataclass
class RecordingReader:
    """One file. Its metadata and its losses are known once its messages have been read."""

    path: Path
    finished: bool = False  # else its recorder was killed, the disk was full, or the file was cut
    losses: Losses = field(default_factory=Losses)
    metadata: dict[str, Any] = field(default_factory=dict[str, Any])

    # What has been read.
    _channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    _schemas: set[int] = field(default_factory=lambda: {NO_SCHEMA})
    _newest_ns: int = 0  # robot time of the newest message
    _unpacked_bytes: int = 0

    # For the losses, by channel: newest sequence number, and how many gaps were known then.
    _last: dict[int, tuple[int, int]] = field(default_factory=dict[int, tuple[int, int]])
    _is_counted: bool = True  # sequence numbers count up, as a recorder of this program writes them

    # The end of the file.
    _file: BinaryIO | None = None
    _summary: list[McapRecord] | None = None  # None: not read

    @property
    def missing(self) -> list[str]:
        """Return what is missing, in words; empty if nothing is."""
        return self.losses.describe()

    def read_messages(self, keys: Collection[str] | None = None) -> Iterator[RecordedMessage]:
        """Yield the messages that the robot's processes published, in the order of the file.

        Messages that the recorder made for viewers are left out.

        Args:
            keys: Keys to read. A pattern of the key space stands for its keys. None: all keys.

        Raises:
            ConfigError: The file is no recording, or cannot be read.
        """
        for record in self.read_records():
            if not isinstance(record, Message):
                continue
            channel = self._channels[record.channel_id]
            key = channel.topic
            encoding = channel.metadata.get("encoding")
            if encoding is None:  # only messages of the robot have one
                continue
            if keys is None or key in keys or find_row_key(key) in keys:
                yield RecordedMessage(key, record.data, encoding, record.log_time, record.publish_time)

    def read_records(self) -> Iterator[McapRecord]:
        """Yield every schema, channel, message and metadata that can be read, a channel before its messages.

        The log time of a message is robot time, and its publish time the wall clock, whatever the stamps of the file.

        Raises:
            ConfigError: The file is no MCAP file, or cannot be read.
        """
        try:
            with self.path.open("rb") as file:
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise ConfigError(
                        f"{self.path} is not a recording: it does not begin as an MCAP file",
                        code="recording/not-readable",
                    )
                self._file = file
                size = os.fstat(file.fileno()).st_size
                yield from self._read_file(file, size)
                self._count_losses_at_end()
        except OSError as error:
            raise ConfigError(f"{self.path} cannot be read: {error.strerror}", code="file/not-readable") from None

    # --- reading

    def _read_file(self, file: BinaryIO, size: int) -> Iterator[McapRecord]:
        """Yield the usable records of a file. Behind a damaged record, continue at the next intact one.

        Damage is counted in `losses`. A file that breaks off without an end record is not damage: `losses.cut_ns` is
        then the time of its newest message.

        Args:
            file: The file, open for reading.
            size: Size of the file in bytes.
        """
        position = len(MCAP0_MAGIC)
        while not self.finished and position < size:
            try:
                raw_record = read_record(file, position, size)
            except DamagedError as error:
                next_position = find_next_record(file, position + 1, size)
                is_cut_end = next_position is None and str(error) == CUT
                if not is_cut_end:
                    self.losses.add_damage(position, str(error), self._newest_ns)
                if next_position is None:
                    break
                position = next_position
                continue
            try:
                for record in self._parse(raw_record):
                    yield from self._process(record)
            except DamagedError as error:
                self.losses.add_damage(position, str(error), self._newest_ns)
            position = raw_record.end
        if not self.finished:
            self.losses.cut_ns = self._newest_ns

    def _parse(self, raw_record: RawRecord) -> Iterator[McapRecord]:
        """Yield the record, or the records of a chunk. Raises DamagedError, ConfigError."""
        opcode = raw_record.opcode
        if opcode == Opcode.CHUNK:
            data = unpack_chunk(raw_record.content)
            self._count_unpacked_bytes(len(data), raw_record.end)
            yield from parse_chunk(data)
        elif opcode == Opcode.DATA_END:
            self.finished = True
            yield DataEnd(0)
        elif opcode in READ_OPCODES:
            yield parse_record(opcode, memoryview(raw_record.content))

    def _count_unpacked_bytes(self, chunk_bytes: int, read_bytes: int) -> None:
        """Raise ConfigError for a file that unpacks to more than a recording can."""
        self._unpacked_bytes += chunk_bytes
        if self._unpacked_bytes > FREE_BYTES + MAX_UNPACKING_RATIO * read_bytes:
            raise ConfigError(
                f"{self.path} is not a recording: its first {read_bytes / 1e6:.2f} MB unpack to "
                f"{self._unpacked_bytes / 1e6:.0f} MB or more, which no messages of a robot do; the most is "
                f"{FREE_BYTES / 1e6:.0f} MB and {MAX_UNPACKING_RATIO} times the file",
                code="recording/not-readable",
            )

    def _process(self, record: McapRecord) -> Iterator[McapRecord]:
        """Take note of one record, and yield it if a caller can use it.

        If the channel or schema of a record was lost, the copy in the file's summary is yielded before it.
        """
        match record:
            case Message():
                if record.channel_id not in self._channels:
                    yield from self._restore_channel(record.channel_id)
                self._use_robot_time(record)
                if self._count_message(record):
                    yield record
            case Channel():
                yield from self._open_channel(record)
            case Schema():
                self._schemas.add(record.id)
                yield record
            case Header():
                self._is_counted = record.profile == PROFILE
            case Metadata(name=name) if name == ABOUT:
                self._read_about(record.metadata)
                yield record
            case _:
                yield record

    def _use_robot_time(self, message: Message) -> None:
        """Let a message have robot time as its log time, and the wall clock as its publish time."""
        channel = self._channels.get(message.channel_id)
        if channel is not None and read_stamps(channel.metadata) == "wall":
            message.log_time, message.publish_time = message.publish_time, message.log_time

    def _open_channel(self, channel: Channel) -> Iterator[McapRecord]:
        """Yield the channel, behind its schema if that was lost and the summary repeats it."""
        self._channels.setdefault(channel.id, channel)
        if channel.schema_id not in self._schemas:
            self._schemas.add(channel.schema_id)
            for record in self._read_summary():
                if isinstance(record, Schema) and record.id == channel.schema_id:
                    yield record
        yield channel

    def _restore_channel(self, number: int) -> Iterator[McapRecord]:
        """Open a channel that was lost, if the summary repeats it."""
        channel = self._find_in_summary(number)
        if channel is not None:
            yield from self._open_channel(channel)

    def _find_in_summary(self, number: int) -> Channel | None:
        """Return the last channel of this number in the summary, or None."""
        found: Channel | None = None
        for record in self._read_summary():
            if isinstance(record, Channel) and record.id == number:
                found = record
        return found

    def _read_summary(self) -> list[McapRecord]:
        """Return channels, schemas and statistics at the end of the file; empty if it has no intact end."""
        if self._summary is None and self._file is not None:
            try:
                self._summary = read_summary(self._file)
            except DamagedError:
                self._summary = []
        return self._summary or []

    def _read_about(self, metadata: dict[str, str]) -> None:
        """Read the recorder's metadata; entries that are no JSON are ignored."""
        for name, value in metadata.items():
            try:
                self.metadata[name] = json.loads(value)
            except (ValueError, RecursionError):
                continue
        dropped = self.metadata.get("dropped")
        if isinstance(dropped, dict):
            self.losses.dropped = {}
            for key, count in dropped.items():
                if isinstance(count, int) and count > 0:
                    self.losses.dropped[str(key)[:MAX_KEY_LENGTH]] = count
        earlier = self.metadata.get(COPIED)
        if isinstance(earlier, list):
            self.losses.earlier = [str(text)[:MAX_EARLIER_LENGTH] for text in earlier[:MAX_EARLIER_LOSSES]]

    # --- losses

    def _count_message(self, message: Message) -> bool:
        """Count the messages that are lost before this one, and return whether this one is usable.

        The recorder numbers the messages of each channel, so a jump of the sequence number means lost messages, and a
        number that does not grow means a message that is behind later ones. A message is not usable if its channel is
        lost or its time is implausible; it then counts as lost.
        """
        channel = self._channels.get(message.channel_id)
        topic = UNKNOWN_KEYS if channel is None else channel.topic
        time_ns = message.log_time
        self._end_gap(time_ns)

        last_sequence, gaps_then = self._last.get(message.channel_id, (0, 0))
        if self._is_counted:
            lost_count = message.sequence - last_sequence - 1
            if lost_count > 0:
                self._add_loss(topic, lost_count, gaps_then, time_ns)
            elif lost_count < 0:
                self.losses.misplaced += 1
        newest_sequence = max(message.sequence, last_sequence)
        self._last[message.channel_id] = (newest_sequence, len(self.losses.gaps))

        is_usable = channel is not None and time_ns < LATEST_NS
        if not is_usable:
            self._add_loss(topic, 1, 0, self._newest_ns)
            return False
        self._newest_ns = max(self._newest_ns, time_ns)
        return True

    def _end_gap(self, time_ns: int) -> None:
        """Let an open gap end at the robot time of a message, if that is plausible."""
        gaps = self.losses.gaps
        if gaps and gaps[-1].end_ns is None and time_ns < LATEST_NS:
            gaps[-1].end_ns = max(time_ns, gaps[-1].begin_ns)

    def _add_loss(self, topic: str, count: int, gaps_then: int, end_ns: int | None) -> None:
        """Count lost messages of a key in the newest gap, or in a new one if there was none since its last message.

        Args:
            topic: The key.
            count: Number of lost messages.
            gaps_then: Number of gaps when the last message of this key was read.
            end_ns: Robot time of the next message; None if there is none.
        """
        gaps = self.losses.gaps
        if len(gaps) <= gaps_then < MAX_GAPS:
            if end_ns is not None:
                end_ns = max(min(end_ns, LATEST_NS), self._newest_ns)
            self.losses.open_gap(self._newest_ns, end_ns)
        gaps[-1].lost[topic] += count

    def _count_losses_at_end(self) -> None:
        """Count what is lost behind the last message of each key, by the statistics of a file that has them."""
        if not self._is_counted:
            return
        for record in self._read_summary():
            if not isinstance(record, Statistics):
                continue
            for number, count in record.channel_message_counts.items():
                last, gaps_then = self._last.get(number, (0, 0))
                if last < count < LATEST_NS:
                    channel = self._channels.get(number) or self._find_in_summary(number)
                    topic = UNKNOWN_KEYS if channel is None else channel.topic
                    self._add_loss(topic, count - last, gaps_then, None)
