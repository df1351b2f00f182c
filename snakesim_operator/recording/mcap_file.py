"""Writes an MCAP file, chunked, indexed and compressed, for little CPU a message: one `pack` and two appends.

The stock writer builds a record of each message field by field, which costs much more. Rare records are built by the
stock library. Source: https://mcap.dev/spec.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Sequence

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import LIBRARY_IDENTIFIER, MCAP0_MAGIC

from snakesim_operator.recording.disk import GrowingFile

PROFILE = "snakesim"
CHUNK_BYTES = 1024 * 1024
COMPRESSION = "zstd"
ZSTD_LEVEL = 2  # two thirds of the time of the default, 3, for files as small; with depth images 4 % larger

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time; then the data
_MESSAGE_FIELD_BYTES = 22  # of the length: channel, sequence and both times
_MESSAGE_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes; then time and offset of each message
_MESSAGE_INDEX_FIELD_BYTES = 6  # of the length: channel and bytes
_FOOTER_WITHOUT_CRC = struct.Struct("<BQQQ")  # opcode, length, position of summary and of summary offsets
_FOOTER_CONTENT_BYTES = 8 + 8 + 4  # two positions and the CRC
_SEQUENCE_MASK = 0xFFFFFFFF  # a sequence number has 32 bits


class McapFile:
    """One file. Everything that is added waits for `flush`; only `flush` and `finish` raise OSError."""

    def __init__(self, file: GrowingFile) -> None:
        """Write the beginning of an MCAP file: the magic bytes and the header.

        Args:
            file: An empty file, which the caller closes.

        Raises:
            OSError: The disk does not take the bytes.
        """
        self._file = file
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)

        # The chunk that is being filled.
        self._chunk = bytearray()
        self._index: dict[int, list[int]] = {}  # by channel: time, offset in the chunk, time, offset ...

        # For the summary at the end of the file.
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunk_indices = RecordBuilder()
        self._metadata_indices = RecordBuilder()
        self._message_counts: Counter[int] = Counter()  # by channel
        self._chunk_count = 0
        self._metadata_count = 0
        self._time_limits_ns: list[int] = []  # the earliest and the latest time so far; empty without messages

        file.write(MCAP0_MAGIC)
        file.write(_encode_records([Header(PROFILE, LIBRARY_IDENTIFIER)]))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema, and return its number."""
        number = len(self._schemas) + 1
        schema = Schema(id=number, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._chunk += _encode_records([schema])
        return number

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str] | None = None) -> int:
        """Add a channel, and return its number. encoding: of its messages."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding=encoding, metadata=metadata or {}, schema_id=schema)
        self._channels.append(channel)
        self._chunk += _encode_records([channel])
        self._index[number] = []
        return number

    def add(self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes) -> None:
        """Add a message to the present chunk, which ends when it is large enough.

        Args:
            channel: Number of its channel.
            log_ns: Log time in ns, 0 to 2**64 - 1.
            publish_ns: Publish time in ns, 0 to 2**64 - 1.
            sequence: Its number in the channel; it wraps around at 2**32.
            data: The encoded message.
        """
        chunk = self._chunk
        self._index[channel] += (log_ns, len(chunk))
        length = _MESSAGE_FIELD_BYTES + len(data)
        chunk += _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence & _SEQUENCE_MASK, log_ns, publish_ns)
        chunk += data
        if len(chunk) > CHUNK_BYTES:
            self._end_chunk()

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record, outside the chunks."""
        self._end_chunk()
        position = self._file.tell()
        record = _encode_records([Metadata(name=name, metadata=content)])
        self._file.write(record)
        MetadataIndex(offset=position, length=len(record), name=name).write(self._metadata_indices)
        self._metadata_count += 1

    def flush(self) -> None:
        """End the chunk and give everything to the disk. Raises OSError."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Write the rest of an MCAP file: the last chunk, the summary section, its offsets, and the footer.

        Raises:
            OSError: The disk does not take the bytes.
        """
        self._end_chunk()
        self._file.write(_encode_records([DataEnd(0)]))

        # The summary holds groups of records of one kind, then an offset for each group.
        summary_position = self._file.tell()
        summary = bytearray()
        offsets = RecordBuilder()
        for opcode, group in self._encode_summary():
            if not group:
                continue
            group_position = summary_position + len(summary)
            SummaryOffset(opcode, group_position, len(group)).write(offsets)
            summary += group
        offsets_position = summary_position + len(summary)
        summary += offsets.end()

        # The checksum covers the summary, and the footer up to the checksum itself.
        footer_without_crc = _FOOTER_WITHOUT_CRC.pack(
            Opcode.FOOTER, _FOOTER_CONTENT_BYTES, summary_position, offsets_position
        )
        summary_crc = zlib.crc32(footer_without_crc, zlib.crc32(summary))
        self._file.write(bytes(summary))
        self._file.write(_encode_records([Footer(summary_position, offsets_position, summary_crc)]))
        self._file.write(MCAP0_MAGIC)
        self._file.flush()

    def _encode_summary(self) -> list[tuple[Opcode, bytes]]:
        """Return the records of the summary section, encoded and grouped by kind.

        Returns:
            The groups in the order of the file: the opcode of the records, and their bytes, which may be empty.
        """
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._message_counts),
            chunk_count=self._chunk_count,
            message_count=self._message_counts.total(),
            message_end_time=max(self._time_limits_ns, default=0),
            message_start_time=min(self._time_limits_ns, default=0),
            metadata_count=self._metadata_count,
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, _encode_records(self._schemas)),
            (Opcode.CHANNEL, _encode_records(self._channels)),
            (Opcode.STATISTICS, _encode_records([statistics])),
            (Opcode.CHUNK_INDEX, self._chunk_indices.end()),
            (Opcode.METADATA_INDEX, self._metadata_indices.end()),
        ]

    def _end_chunk(self) -> None:
        """Write the current chunk and its message indexes to the file, and begin an empty chunk.

        A chunk without messages is not written. For the summary at the end of the file, this also counts the messages
        and remembers where the chunk is.
        """
        indices = {channel: index for channel, index in self._index.items() if index}
        if not indices:
            return

        # Each index alternates between time and offset.
        begin_ns = min(min(index[::2]) for index in indices.values())
        end_ns = max(max(index[::2]) for index in indices.values())
        compressed = self._compressor.compress(self._chunk)
        chunk_position = self._file.tell()
        records = RecordBuilder()
        chunk = Chunk(
            compression=COMPRESSION,
            data=compressed,
            message_end_time=end_ns,
            message_start_time=begin_ns,
            uncompressed_crc=zlib.crc32(self._chunk),
            uncompressed_size=len(self._chunk),
        )
        chunk.write(records)
        chunk_length = records.count

        index_positions: dict[int, int] = {}
        for channel, index in indices.items():
            index_positions[channel] = chunk_position + records.count
            _add_message_index(records, channel, index)
            self._message_counts[channel] += len(index) // 2
            self._index[channel] = []

        chunk_index = ChunkIndex(
            chunk_length=chunk_length,
            chunk_start_offset=chunk_position,
            compression=COMPRESSION,
            compressed_size=len(compressed),
            message_end_time=end_ns,
            message_index_length=records.count - chunk_length,
            message_index_offsets=index_positions,
            message_start_time=begin_ns,
            uncompressed_size=len(self._chunk),
        )
        chunk_index.write(self._chunk_indices)
        self._file.write(records.end())

        earliest_ns = min([begin_ns, *self._time_limits_ns])
        latest_ns = max([end_ns, *self._time_limits_ns])
        self._time_limits_ns = [earliest_ns, latest_ns]
        self._chunk_count += 1
        self._chunk.clear()


def _add_message_index(records: RecordBuilder, channel: int, index: list[int]) -> None:
    """Add the record that lists time and offset of a channel's messages in the chunk before it."""
    entry_bytes = 8 * len(index)
    length = _MESSAGE_INDEX_FIELD_BYTES + entry_bytes
    records.write(_MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, entry_bytes))
    records.write(struct.pack(f"<{len(index)}Q", *index))


def _encode_records(records: Sequence[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()
