"""Writes an MCAP file, chunked, indexed and compressed, for little CPU a message: one `pack` and two appends.

The stock writer builds a record of each message field by field, which costs much more; records that are rare are its
own. Source: https://mcap.dev/spec.
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
ZSTD_LEVEL = 2  # two thirds of the time of the default, 3, for files as small; with depth images 4 % larger
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time; then the data
_MESSAGE_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes; then time and offset of each message


class McapFile:
    """One file. What is added waits for `flush`, the only one that raises OSError, but for `finish`."""

    def __init__(self, file: GrowingFile) -> None:
        """Begin the file."""
        self._file = file
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._chunk = bytearray()
        self._index: dict[int, list[int]] = {}  # channel -> time, offset, time, offset ... within the chunk
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunk_indices, self._metadata_indices = RecordBuilder(), RecordBuilder()
        self._counts: Counter[int] = Counter()  # messages, by channel
        self._spans_ns: list[int] = []  # the earliest and the latest time so far
        self._chunks = self._metadata = 0
        file.write(MCAP0_MAGIC)
        file.write(_written([Header(PROFILE, LIBRARY_IDENTIFIER)]))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """The number of a new schema."""
        self._schemas.append(Schema(len(self._schemas) + 1, data, encoding, name))
        self._chunk += _written(self._schemas[-1:])
        return len(self._schemas)

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str] | None = None) -> int:
        """The number of a new channel."""
        number = len(self._channels) + 1
        self._channels.append(Channel(number, topic, encoding, metadata or {}, schema))
        self._chunk += _written(self._channels[-1:])
        self._index[number] = []
        return number

    def add(self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes) -> None:
        """Add a message. Times in ns, 0 to 2**64 - 1; sequence wraps around at 2**32."""
        chunk = self._chunk
        self._index[channel] += (log_ns, len(chunk))
        chunk += _MESSAGE.pack(Opcode.MESSAGE, 22 + len(data), channel, sequence & 0xFFFFFFFF, log_ns, publish_ns)
        chunk += data
        if len(chunk) > CHUNK_BYTES:
            self._end_chunk()

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record, outside the chunks."""
        self._end_chunk()
        record, at = _written([Metadata(name=name, metadata=content)]), self._file.tell()
        self._file.write(record)
        MetadataIndex(offset=at, length=len(record), name=name).write(self._metadata_indices)
        self._metadata += 1

    def flush(self) -> None:
        """End the chunk and give everything to the disk. Raises OSError."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Write summary and footer. Raises OSError."""
        self._end_chunk()
        self._file.write(_written([DataEnd(0)]))
        summary_at, summary, offsets = self._file.tell(), bytearray(), RecordBuilder()
        for opcode, group in self._summary():
            if group:
                SummaryOffset(opcode, summary_at + len(summary), len(group)).write(offsets)
                summary += group
        offsets_at = summary_at + len(summary)
        summary += offsets.end()
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 8 + 8 + 4, summary_at, offsets_at)
        self._file.write(bytes(summary))
        self._file.write(_written([Footer(summary_at, offsets_at, zlib.crc32(footer, zlib.crc32(summary)))]))
        self._file.write(MCAP0_MAGIC)
        self._file.flush()

    def _summary(self) -> list[tuple[Opcode, bytes]]:
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=self._counts.total(),
            message_end_time=max(self._spans_ns, default=0),
            message_start_time=min(self._spans_ns, default=0),
            metadata_count=self._metadata,
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, _written(self._schemas)),
            (Opcode.CHANNEL, _written(self._channels)),
            (Opcode.STATISTICS, _written([statistics])),
            (Opcode.CHUNK_INDEX, self._chunk_indices.end()),
            (Opcode.METADATA_INDEX, self._metadata_indices.end()),
        ]

    def _end_chunk(self) -> None:
        filled = {channel: index for channel, index in self._index.items() if index}
        if not filled:
            return
        begin_ns = min(min(index[::2]) for index in filled.values())
        end_ns = max(max(index[::2]) for index in filled.values())
        data = self._compressor.compress(self._chunk)
        at, records = self._file.tell(), RecordBuilder()
        Chunk("zstd", data, end_ns, begin_ns, zlib.crc32(self._chunk), len(self._chunk)).write(records)
        length, offsets = records.count, dict[int, int]()
        for channel, index in filled.items():
            offsets[channel] = at + records.count
            size = 8 * len(index)
            records.write(_MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size))
            records.write(struct.pack(f"<{len(index)}Q", *index))
            self._counts[channel] += len(index) // 2
            self._index[channel] = []
        after = records.count - length
        index = ChunkIndex(length, at, "zstd", len(data), end_ns, after, offsets, begin_ns, len(self._chunk))
        index.write(self._chunk_indices)
        self._file.write(records.end())
        self._spans_ns = [min([begin_ns, *self._spans_ns]), max([end_ns, *self._spans_ns])]
        self._chunks += 1
        self._chunk.clear()


def _written(records: Sequence[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()
