"""Unpacks the records of an MCAP file within bounds: no memory is allocated because a header claims that it is needed.

Source: https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO

import lz4.frame
import mcap.exceptions
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Header, McapRecord, Message, Metadata, Schema, Statistics

# Of a record, and of an unpacked chunk: a recorder writes 1 MB, and an image.
MAX_RECORD_BYTES = 64 * 1024 * 1024
DECOMPRESSION_STEP_BYTES = 1024 * 1024  # memory grows with what is really unpacked
RECORD_HEADER = struct.Struct("<BQ")  # opcode and length of every record
# Begin, end, unpacked size, its CRC, length of the compression's name.
_CHUNK_HEADER = struct.Struct("<QQQII")
_COMPRESSED_LENGTH = struct.Struct("<Q")  # behind the compression's name
_MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data
_RECORD_TYPES: dict[int, type[Channel | Header | Metadata | Schema | Statistics]] = {
    Opcode.CHANNEL: Channel,
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.SCHEMA: Schema,
    Opcode.STATISTICS: Statistics,
}
_CHUNK_RECORDS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_PARSING_ERRORS = (mcap.exceptions.McapError, struct.error, ValueError, OverflowError, MemoryError)
_UNPACKING_ERRORS = (zstandard.ZstdError, RuntimeError, EOFError, MemoryError)


class CorruptFileError(Exception):
    """A record is damaged; the text explains how."""


def read_chunk_length(content_prefix: bytes) -> int:
    """Return the length of a chunk's content in bytes, by the lengths that its header states.

    Args:
        content_prefix: The first bytes of the content, with the whole header of the chunk.

    Raises:
        CorruptFileError: The header of the chunk is incomplete.
    """
    try:
        *_, name_bytes = _CHUNK_HEADER.unpack_from(content_prefix)
        (compressed_bytes,) = _COMPRESSED_LENGTH.unpack_from(
            content_prefix, _CHUNK_HEADER.size + name_bytes
        )
    except struct.error:
        raise CorruptFileError("a chunk whose lengths cannot be") from None
    return _CHUNK_HEADER.size + name_bytes + _COMPRESSED_LENGTH.size + compressed_bytes


def unpack_chunk(content: bytes) -> bytearray:
    """Decompress a chunk of an MCAP file, and check its lengths and its checksum.

    Args:
        content: Content of the chunk's record: a header, the name of the compression, and the compressed records.

    Returns:
        The records in the chunk, as bytes.

    Raises:
        CorruptFileError: The lengths, the compression, the size or the checksum of the chunk is wrong.
    """
    if read_chunk_length(content) != len(content):
        raise CorruptFileError("a chunk whose lengths contradict each other")
    _, _, unpacked_bytes, expected_crc, name_bytes = _CHUNK_HEADER.unpack_from(content)
    name_end = _CHUNK_HEADER.size + name_bytes
    compression = content[_CHUNK_HEADER.size : name_end]
    compressed = content[name_end + _COMPRESSED_LENGTH.size :]
    if unpacked_bytes > MAX_RECORD_BYTES:
        raise CorruptFileError(
            f"a chunk of {unpacked_bytes / 1e6:.0f} MB, more than {MAX_RECORD_BYTES / 1e6:.0f} MB"
        )
    try:
        data = _decompress(compression, compressed, unpacked_bytes)
    except _UNPACKING_ERRORS as error:
        raise CorruptFileError(f"a chunk that cannot be unpacked ({error})") from None
    if len(data) != unpacked_bytes:
        raise CorruptFileError(f"a chunk of {len(data)} bytes where {unpacked_bytes} should be")
    has_checksum = expected_crc != 0
    if has_checksum and zlib.crc32(data) != expected_crc:
        raise CorruptFileError("a chunk whose checksum does not fit")
    return data


def _decompress(compression: bytes, compressed: bytes, max_bytes: int) -> bytearray:
    """Return the unpacked bytes, but at most `max_bytes`. Raises CorruptFileError for an unknown compression."""
    match compression:
        case b"zstd":
            with zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES).stream_reader(
                compressed
            ) as stream:
                return _read_in_steps(stream.read, max_bytes)
        case b"lz4":
            return _decompress_lz4(compressed, max_bytes)
        case b"":
            return bytearray(compressed)
        case _:
            raise CorruptFileError("a chunk of an unknown compression")


def _decompress_lz4(compressed: bytes, max_bytes: int) -> bytearray:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    remaining_input = compressed  # the decompressor takes all of it in the first step

    def read(step_bytes: int) -> bytes:
        nonlocal remaining_input
        if decompressor.eof:
            return b""
        next_input = remaining_input
        remaining_input = b""
        return decompressor.decompress(next_input, max_length=step_bytes)

    return _read_in_steps(read, max_bytes)


def _read_in_steps(read: Callable[[int], bytes], max_bytes: int) -> bytearray:
    """Return up to `max_bytes` bytes; fewer if the input ends before."""
    data = bytearray()
    while len(data) < max_bytes:
        part = read(min(max_bytes - len(data), DECOMPRESSION_STEP_BYTES))
        if not part:
            break
        data += part
    return data


def parse_chunk(data: bytearray) -> Iterator[McapRecord]:
    """Yield schemas, channels and messages of an unpacked chunk. Raises CorruptFileError."""
    view = memoryview(data)
    position = 0
    while position < len(data):
        if position + RECORD_HEADER.size > len(data):
            raise CorruptFileError("a record that its chunk cuts off")
        opcode, length = RECORD_HEADER.unpack_from(data, position)
        position += RECORD_HEADER.size
        if position + length > len(data):
            raise CorruptFileError("a record that is longer than its chunk")
        if opcode in _CHUNK_RECORDS:
            yield parse_record(opcode, view[position : position + length])
        position += length


def parse_record(opcode: int, content: memoryview) -> McapRecord:
    """Decode the content of one MCAP record, and check that its length is right.

    Args:
        opcode: Kind of the record: a message, channel, header, metadata, schema or statistics.
        content: The bytes behind the record's opcode and length.

    Raises:
        CorruptFileError: The content cannot be read, or is longer than what it holds.
    """
    if opcode == Opcode.MESSAGE:
        return _parse_message(content)
    stream = ReadDataStream(BytesIO(content))
    try:
        record = _RECORD_TYPES[opcode].read(stream)
    except _PARSING_ERRORS:
        raise CorruptFileError(f"a record of kind {opcode} that cannot be read") from None
    read_bytes = stream.count
    if read_bytes != len(content):
        raise CorruptFileError(f"a record of kind {opcode} whose lengths contradict each other")
    return record


def _parse_message(content: memoryview) -> Message:
    if len(content) < _MESSAGE_HEADER.size:
        raise CorruptFileError("a message without a head")
    channel_id, sequence, log_time_ns, publish_time_ns = _MESSAGE_HEADER.unpack_from(content)
    return Message(
        channel_id=channel_id,
        log_time=log_time_ns,
        data=bytes(content[_MESSAGE_HEADER.size :]),
        publish_time=publish_time_ns,
        sequence=sequence,
    )
