"""Reads a recording: the messages in the order of the file, also of one that is damaged or was never finished.

Damage does not end the reading: it continues at the next intact chunk. What is lost in between is known from the
messages' sequence numbers, which count up for each key, and from the file's own statistics if it has an end.
"""

import json
import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Header, McapRecord, Message, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.keys import find_row_key
from snakesim_operator.recording.log_clock import read_log_time_clock
from snakesim_operator.recording.losses import MAX_GAPS, UNKNOWN_KEYS, RecordingLosses
from snakesim_operator.recording.mcap_format.chunks import (
    CorruptFileError,
    parse_chunk,
    parse_record,
    unpack_chunk,
)
from snakesim_operator.recording.mcap_format.file_writer import (
    EARLIER_LOSSES_ENTRY,
    METADATA_NAME,
    SNAKESIM_PROFILE,
)
from snakesim_operator.recording.mcap_format.records import (
    OPCODES_TO_READ,
    TRUNCATED,
    RawRecord,
    find_next_record,
    read_record,
    read_summary,
)
from snakesim_operator.recording.message import RecordedMessage

MAX_ROBOT_TIME_NS = 2**62  # 146 years: no robot time is later
NO_SCHEMA = 0  # MCAP's number for a channel without a schema

# A file may unpack to MAX_UNPACKING_RATIO times its size plus UNPACKING_ALLOWANCE_BYTES. No recording exceeds that.
MAX_UNPACKING_RATIO = 100
UNPACKING_ALLOWANCE_BYTES = 32 * 1024 * 1024

# Bounds of the metadata, which comes from the file.
MAX_KEY_LENGTH = 200
MAX_EARLIER_LOSSES = 10
MAX_EARLIER_LENGTH = 500


class _ChannelPosition(NamedTuple):
    """How far the messages of one channel have been read."""

    sequence: int  # sequence number of the newest message
    gap_count: int  # number of gaps in the recording that were known when it was read


_UNREAD_CHANNEL = _ChannelPosition(sequence=0, gap_count=0)


@dataclass
class RecordingReader:
    """Reads one recording. Its metadata and its losses are known once its messages have been read."""

    path: Path
    # Else its recorder was killed, the disk was full, or the file was cut.
    is_complete: bool = False
    losses: RecordingLosses = field(default_factory=RecordingLosses)
    metadata: dict[str, Any] = field(default_factory=dict[str, Any])

    # What has been read.
    _channel_by_id: dict[int, Channel] = field(default_factory=dict[int, Channel])
    _known_schema_ids: set[int] = field(default_factory=lambda: {NO_SCHEMA})
    _newest_time_ns: int = 0  # robot time of the newest message
    _unpacked_bytes: int = 0

    # For the losses.
    _last_position_by_channel: dict[int, _ChannelPosition] = field(
        default_factory=dict[int, _ChannelPosition]
    )
    # They count up for each channel, as a recorder of this program writes them.
    _has_sequence_numbers: bool = True

    # The end of the file.
    _file: BinaryIO | None = None
    _summary: list[McapRecord] | None = None  # None: not read

    @property
    def missing(self) -> list[str]:
        """Return sentences about what the recording has lost; empty if nothing is lost."""
        return self.losses.describe()

    def read_messages(self, keys: Collection[str] | None = None) -> Iterator[RecordedMessage]:
        """Yield the messages that the robot's processes published, in the order of the file.

        Messages that the recorder made for viewers are left out.

        Args:
            keys: Keys to read. A pattern of the key space stands for its keys. If None, all keys are read.

        Raises:
            ConfigError: The file is no recording, or cannot be read.
        """
        for record in self.read_records():
            if not isinstance(record, Message):
                continue
            channel = self._channel_by_id[record.channel_id]
            key = channel.topic
            encoding = channel.metadata.get("encoding")
            # Only channels of the robot's own messages state an encoding.
            is_made_for_viewers = encoding is None
            if is_made_for_viewers:
                continue
            if keys is None or key in keys or find_row_key(key) in keys:
                yield RecordedMessage(
                    key, record.data, encoding, record.log_time, record.publish_time
                )

    def read_records(self) -> Iterator[McapRecord]:
        """Yield every schema, channel, message and metadata that can be read, a channel before its messages.

        In the returned messages, `log_time` is always robot time and `publish_time` the wall clock, whichever of the
        two clocks the file uses for its log times.

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
                yield from self._read_file_records(file, size)
                self._count_losses_at_end()
        except OSError as error:
            raise ConfigError(
                f"{self.path} cannot be read: {error.strerror}", code="file/not-readable"
            ) from None

    # --- reading

    def _read_file_records(self, file: BinaryIO, file_size: int) -> Iterator[McapRecord]:
        """Yield the usable records of a file. Behind a damaged record, continue at the next intact one.

        Damage is counted in `losses`. A file that breaks off without an end record is not damage: `losses.cut_ns` is
        then the time of its newest message.

        Args:
            file: The file, open for reading.
            file_size: Size of the file in bytes.
        """
        position = len(MCAP0_MAGIC)
        while not self.is_complete and position < file_size:
            try:
                raw_record = read_record(file, position, file_size)
            except CorruptFileError as error:
                next_position = find_next_record(file, position + 1, file_size)
                is_cut_end = next_position is None and str(error) == TRUNCATED
                if not is_cut_end:
                    self.losses.add_damage(position, str(error), self._newest_time_ns)
                if next_position is None:
                    break
                position = next_position
                continue
            try:
                for record in self._parse_raw_record(raw_record):
                    yield from self._filter_record(record)
            except CorruptFileError as error:
                self.losses.add_damage(position, str(error), self._newest_time_ns)
            position = raw_record.end
        if not self.is_complete:
            self.losses.truncated_at_ns = self._newest_time_ns

    def _parse_raw_record(self, raw_record: RawRecord) -> Iterator[McapRecord]:
        """Yield one record, or all records of a chunk; nothing for records that no reader needs.

        Raises:
            CorruptFileError: The content of the record is damaged.
            ConfigError: The chunks unpack to more than a recording can have.
        """
        opcode = raw_record.opcode
        if opcode == Opcode.CHUNK:
            data = unpack_chunk(raw_record.content)
            self._limit_unpacked_bytes(len(data), raw_record.end)
            yield from parse_chunk(data)
        elif opcode == Opcode.DATA_END:
            self.is_complete = True
            yield DataEnd(0)
        elif opcode in OPCODES_TO_READ:
            yield parse_record(opcode, memoryview(raw_record.content))

    def _limit_unpacked_bytes(self, chunk_bytes: int, read_bytes: int) -> None:
        """Add the size of an unpacked chunk, and check that the file does not unpack to more than a recording can.

        Args:
            chunk_bytes: Size of the unpacked chunk in bytes.
            read_bytes: Size of the file up to the end of this chunk in bytes.

        Raises:
            ConfigError: The file unpacks to too much data.
        """
        self._unpacked_bytes += chunk_bytes
        if self._unpacked_bytes > UNPACKING_ALLOWANCE_BYTES + MAX_UNPACKING_RATIO * read_bytes:
            raise ConfigError(
                f"{self.path} is not a recording: its first {read_bytes / 1e6:.2f} MB unpack to "
                f"{self._unpacked_bytes / 1e6:.0f} MB or more, which no messages of a robot do; the most is "
                f"{UNPACKING_ALLOWANCE_BYTES / 1e6:.0f} MB and {MAX_UNPACKING_RATIO} times the file",
                code="recording/not-readable",
            )

    def _filter_record(self, record: McapRecord) -> Iterator[McapRecord]:
        """Update the channel, schema and loss state from a record, and yield the record if a caller can use it.

        A message is yielded only if its channel is known and its time is plausible. If its channel or schema was
        lost, the copy in the summary of the file is yielded first. The file header is not yielded: it only states
        whether the messages have sequence numbers. All other records are yielded.
        """
        match record:
            case Message():
                if record.channel_id not in self._channel_by_id:
                    yield from self._restore_channel_from_summary(record.channel_id)
                self._set_log_time_to_robot_time(record)
                if self._accept_message(record):
                    yield record
            case Channel():
                yield from self._register_channel(record)
            case Schema():
                self._known_schema_ids.add(record.id)
                yield record
            case Header():
                self._has_sequence_numbers = record.profile == SNAKESIM_PROFILE
            case Metadata(name=name) if name == METADATA_NAME:
                self._read_recorder_metadata(record.metadata)
                yield record
            case _:
                yield record

    def _set_log_time_to_robot_time(self, message: Message) -> None:
        """Swap the times of a message if its file uses the wall clock as log time; the message is changed in place."""
        channel = self._channel_by_id.get(message.channel_id)
        if channel is not None and read_log_time_clock(channel.metadata) == "wall":
            message.log_time, message.publish_time = message.publish_time, message.log_time

    def _register_channel(self, channel: Channel) -> Iterator[McapRecord]:
        """Remember a channel, and yield it. If its schema was lost, the copy in the summary is yielded first."""
        self._channel_by_id.setdefault(channel.id, channel)
        if channel.schema_id not in self._known_schema_ids:
            self._known_schema_ids.add(channel.schema_id)
            for record in self._read_summary():
                if isinstance(record, Schema) and record.id == channel.schema_id:
                    yield record
        yield channel

    def _restore_channel_from_summary(self, channel_id: int) -> Iterator[McapRecord]:
        """Yield a channel that was lost, if the summary of the file has a copy of it."""
        channel = self._find_channel_in_summary(channel_id)
        if channel is not None:
            yield from self._register_channel(channel)

    def _find_channel_in_summary(self, channel_id: int) -> Channel | None:
        """Return the last channel with this id in the summary of the file, or None if there is none."""
        found: Channel | None = None
        for record in self._read_summary():
            if isinstance(record, Channel) and record.id == channel_id:
                found = record
        return found

    def _read_summary(self) -> list[McapRecord]:
        """Return the channels, schemas and statistics at the end of the file; empty if it has no intact end.

        The file is read only once.
        """
        if self._summary is None and self._file is not None:
            try:
                self._summary = read_summary(self._file)
            except CorruptFileError:
                self._summary = []
        return self._summary or []

    def _read_recorder_metadata(self, metadata: dict[str, str]) -> None:
        """Store the metadata that the recorder wrote about itself, and the losses that it states.

        Args:
            metadata: JSON texts by name; entries that are not JSON are ignored.
        """
        for name, value in metadata.items():
            try:
                self.metadata[name] = json.loads(value)
            except (ValueError, RecursionError):
                continue
        dropped = self.metadata.get("dropped")
        if isinstance(dropped, dict):
            self.losses.dropped_count_by_key = {}
            for key, count in dropped.items():
                if isinstance(count, int) and count > 0:
                    self.losses.dropped_count_by_key[str(key)[:MAX_KEY_LENGTH]] = count
        earlier = self.metadata.get(EARLIER_LOSSES_ENTRY)
        if isinstance(earlier, list):
            self.losses.earlier_losses = [
                str(text)[:MAX_EARLIER_LENGTH] for text in earlier[:MAX_EARLIER_LOSSES]
            ]

    # --- losses

    def _accept_message(self, message: Message) -> bool:
        """Count the messages that were lost before a message, and decide whether the message itself is usable.

        The recorder numbers the messages of each channel. So a jump of the sequence number means lost messages, and a
        number that does not grow means a message that is stored after a later one. A message is not usable if its
        channel is lost or its time is implausible; it is then counted as lost.

        Args:
            message: The message, with robot time as its log time.

        Returns:
            Whether the message is usable.
        """
        channel = self._channel_by_id.get(message.channel_id)
        key = UNKNOWN_KEYS if channel is None else channel.topic
        time_ns = message.log_time
        self._close_gap(time_ns)

        last = self._last_position_by_channel.get(message.channel_id, _UNREAD_CHANNEL)
        if self._has_sequence_numbers:
            lost_count = message.sequence - last.sequence - 1
            if lost_count > 0:
                self._add_loss(key, lost_count, last.gap_count, time_ns)
            elif lost_count < 0:
                self.losses.misplaced_count += 1
        newest_sequence = max(message.sequence, last.sequence)
        position = _ChannelPosition(newest_sequence, len(self.losses.gaps))
        self._last_position_by_channel[message.channel_id] = position

        is_usable = channel is not None and time_ns < MAX_ROBOT_TIME_NS
        if not is_usable:
            self._add_loss(key, 1, 0, self._newest_time_ns)
            return False
        self._newest_time_ns = max(self._newest_time_ns, time_ns)
        return True

    def _close_gap(self, time_ns: int) -> None:
        """End the newest gap at the robot time of the next readable message, if that time is plausible."""
        gaps = self.losses.gaps
        if gaps and gaps[-1].end_ns is None and time_ns < MAX_ROBOT_TIME_NS:
            gaps[-1].end_ns = max(time_ns, gaps[-1].begin_ns)

    def _add_loss(
        self, key: str, count: int, gap_count_at_last_message: int, end_ns: int | None
    ) -> None:
        """Count lost messages of a key in the newest gap, or in a new one if there was none since its last message.

        Args:
            key: Key of the lost messages.
            count: Number of lost messages.
            gap_count_at_last_message: Number of gaps that were known when the last message of this key was read.
            end_ns: Robot time of the next message; None if there is none.
        """
        gaps = self.losses.gaps
        has_no_gap_since_last_message = len(gaps) <= gap_count_at_last_message
        if has_no_gap_since_last_message and gap_count_at_last_message < MAX_GAPS:
            if end_ns is not None:
                end_ns = max(min(end_ns, MAX_ROBOT_TIME_NS), self._newest_time_ns)
            self.losses.open_gap(self._newest_time_ns, end_ns)
        gaps[-1].lost[key] += count

    def _count_losses_at_end(self) -> None:
        """Count the messages that are lost after the last message of each key, by the statistics of the file."""
        if not self._has_sequence_numbers:
            return
        for record in self._read_summary():
            if not isinstance(record, Statistics):
                continue
            for channel_id, message_count in record.channel_message_counts.items():
                last = self._last_position_by_channel.get(channel_id, _UNREAD_CHANNEL)
                has_plausible_loss = last.sequence < message_count < MAX_ROBOT_TIME_NS
                if has_plausible_loss:
                    channel = self._channel_by_id.get(channel_id) or self._find_channel_in_summary(
                        channel_id
                    )
                    key = UNKNOWN_KEYS if channel is None else channel.topic
                    self._add_loss(key, message_count - last.sequence, last.gap_count, None)
