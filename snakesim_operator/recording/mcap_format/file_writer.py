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

from snakesim_operator.recording.buffered_file import GrowingFile

SNAKESIM_PROFILE = "snakesim"
METADATA_NAME = "snakesim"  # the name of the metadata record
# Entry of that record: what the recording lacked that this one was copied from.
EARLIER_LOSSES_ENTRY = "lacked_before_copy"
CHUNK_BYTES = 1024 * 1024
COMPRESSION = "zstd"
# Two thirds of the time of the default, 3, for files as small; with depth images 4 % larger.
ZSTD_LEVEL = 2

# Opcode, length, channel, sequence, log time, publish time; then the data.
_MESSAGE_HEADER = struct.Struct("<BQHIQQ")
_MESSAGE_FIELD_BYTES = 22  # of the length: channel, sequence and both times
# Opcode, length, channel, bytes; then time and offset of each message.
_MESSAGE_INDEX_HEADER = struct.Struct("<BQHI")
_MESSAGE_INDEX_FIELD_BYTES = 6  # of the length: channel and bytes
# Opcode, length, position of summary and of summary offsets.
_FOOTER_WITHOUT_CRC = struct.Struct("<BQQQ")
_FOOTER_CONTENT_BYTES = 8 + 8 + 4  # two positions and the CRC
_SEQUENCE_MASK = 0xFFFFFFFF  # a sequence number has 32 bits


class McapFileWriter:
    """Writes one MCAP file. Records are buffered until `flush`; only `flush` and `finish_file` raise OSError."""

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
        # By channel: time, offset in the chunk, time, offset ...
        self._message_index_by_channel: dict[int, list[int]] = {}

        # For the summary at the end of the file.
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunk_index_records = RecordBuilder()
        self._metadata_index_records = RecordBuilder()
        self._message_count_by_channel: Counter[int] = Counter()  # by channel
        self._chunk_count = 0
        self._metadata_count = 0
        # The earliest and the latest time so far; empty without messages.
        self._time_range_ns: list[int] = []

        file.write(MCAP0_MAGIC)
        file.write(_encode_records([Header(SNAKESIM_PROFILE, LIBRARY_IDENTIFIER)]))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema, and return its id in the file.

        Args:
            name: Name of the schema.
            encoding: Language of the schema, such as `jsonschema`.
            data: Text of the schema, encoded.
        """
        schema_id = len(self._schemas) + 1
        schema = Schema(id=schema_id, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._chunk += _encode_records([schema])
        return schema_id

    def add_channel(
        self, topic: str, encoding: str, schema_id: int, metadata: dict[str, str] | None = None
    ) -> int:
        """Add a channel, and return its id in the file.

        Args:
            topic: Name of the channel.
            encoding: Encoding of its messages, such as `msgpack`.
            schema_id: Id of the schema of its messages; 0 if there is none.
            metadata: Further texts by name.
        """
        channel_id = len(self._channels) + 1
        channel = Channel(
            id=channel_id,
            topic=topic,
            message_encoding=encoding,
            metadata=metadata or {},
            schema_id=schema_id,
        )
        self._channels.append(channel)
        self._chunk += _encode_records([channel])
        self._message_index_by_channel[channel_id] = []
        return channel_id

    def add_message(
        self, channel_id: int, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes
    ) -> None:
        """Add a message to the current chunk, and write the chunk once it is large enough.

        Args:
            channel_id: Id of the message's channel.
            log_time_ns: Log time in ns, 0 to 2**64 - 1.
            publish_time_ns: Publish time in ns, 0 to 2**64 - 1.
            sequence: Sequence number of the message in its channel; stored modulo 2**32.
            data: The encoded message.
        """
        chunk = self._chunk
        self._message_index_by_channel[channel_id] += (log_time_ns, len(chunk))
        length = _MESSAGE_FIELD_BYTES + len(data)
        chunk += _MESSAGE_HEADER.pack(
            Opcode.MESSAGE,
            length,
            channel_id,
            sequence & _SEQUENCE_MASK,
            log_time_ns,
            publish_time_ns,
        )
        chunk += data
        if len(chunk) > CHUNK_BYTES:
            self._write_chunk()

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record, which is outside the chunks: the current chunk is written first."""
        self._write_chunk()
        position = self._file.tell()
        record = _encode_records([Metadata(name=name, metadata=content)])
        self._file.write(record)
        MetadataIndex(offset=position, length=len(record), name=name).write(
            self._metadata_index_records
        )
        self._metadata_count += 1

    def flush(self) -> None:
        """End the current chunk, and write everything to the disk.

        Raises:
            OSError: The disk does not take the bytes.
        """
        self._write_chunk()
        self._file.flush()

    def finish_file(self) -> None:
        """Write the rest of an MCAP file: the last chunk, the summary section, its offsets, and the footer.

        Raises:
            OSError: The disk does not take the bytes.
        """
        self._write_chunk()
        self._file.write(_encode_records([DataEnd(0)]))

        # The summary holds groups of records of one kind, then an offset for each group.
        summary_position = self._file.tell()
        summary = bytearray()
        offsets = RecordBuilder()
        for opcode, group in self._encode_summary_groups():
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

    def _encode_summary_groups(self) -> list[tuple[Opcode, bytes]]:
        """Encode the records of the summary section, grouped by kind.

        Returns:
            The groups in the order of the file. Each has the opcode of its records, and their bytes, which are empty
            if there are no such records.
        """
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._message_count_by_channel),
            chunk_count=self._chunk_count,
            message_count=self._message_count_by_channel.total(),
            message_end_time=max(self._time_range_ns, default=0),
            message_start_time=min(self._time_range_ns, default=0),
            metadata_count=self._metadata_count,
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, _encode_records(self._schemas)),
            (Opcode.CHANNEL, _encode_records(self._channels)),
            (Opcode.STATISTICS, _encode_records([statistics])),
            (Opcode.CHUNK_INDEX, self._chunk_index_records.end()),
            (Opcode.METADATA_INDEX, self._metadata_index_records.end()),
        ]

    def _write_chunk(self) -> None:
        """Write the current chunk and its message indexes to the file, and start an empty chunk.

        A chunk without messages is not written. For the summary at the end of the file, the messages are counted, and
        the position of the chunk is stored.
        """
        index_by_channel = {
            channel: index for channel, index in self._message_index_by_channel.items() if index
        }
        if not index_by_channel:
            return

        # Each index alternates between log time and offset in the chunk.
        start_time_ns = min(min(index[::2]) for index in index_by_channel.values())
        end_time_ns = max(max(index[::2]) for index in index_by_channel.values())
        compressed = self._compressor.compress(self._chunk)
        chunk_position = self._file.tell()
        records = RecordBuilder()
        chunk = Chunk(
            compression=COMPRESSION,
            data=compressed,
            message_end_time=end_time_ns,
            message_start_time=start_time_ns,
            uncompressed_crc=zlib.crc32(self._chunk),
            uncompressed_size=len(self._chunk),
        )
        chunk.write(records)
        chunk_length = records.count

        index_position_by_channel: dict[int, int] = {}
        for channel, index in index_by_channel.items():
            index_position_by_channel[channel] = chunk_position + records.count
            _add_message_index(records, channel, index)
            self._message_count_by_channel[channel] += len(index) // 2
            self._message_index_by_channel[channel] = []

        chunk_index = ChunkIndex(
            chunk_length=chunk_length,
            chunk_start_offset=chunk_position,
            compression=COMPRESSION,
            compressed_size=len(compressed),
            message_end_time=end_time_ns,
            message_index_length=records.count - chunk_length,
            message_index_offsets=index_position_by_channel,
            message_start_time=start_time_ns,
            uncompressed_size=len(self._chunk),
        )
        chunk_index.write(self._chunk_index_records)
        self._file.write(records.end())

        earliest_ns = min([start_time_ns, *self._time_range_ns])
        latest_ns = max([end_time_ns, *self._time_range_ns])
        self._time_range_ns = [earliest_ns, latest_ns]
        self._chunk_count += 1
        self._chunk.clear()


def _add_message_index(records: RecordBuilder, channel_id: int, index: list[int]) -> None:
    """Append the MessageIndex record of one channel, which follows the chunk that it describes.

    Args:
        records: Receives the record.
        channel_id: Id of the channel.
        index: Log time in ns and offset in the chunk of each message, alternating.
    """
    entry_bytes = 8 * len(index)
    length = _MESSAGE_INDEX_FIELD_BYTES + entry_bytes
    records.write(_MESSAGE_INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, length, channel_id, entry_bytes))
    records.write(struct.pack(f"<{len(index)}Q", *index))


def _encode_records(records: Sequence[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()
