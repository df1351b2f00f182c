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

MAX_RECORD_BYTES = 64 * 1024 * 1024  # of a record, and of an unpacked chunk: a recorder writes 1 MB, and an image
UNPACK_STEP_BYTES = 1024 * 1024  # memory grows with what is really unpacked
HEAD = struct.Struct("<BQ")  # opcode and length of every record
_CHUNK_HEAD = struct.Struct("<QQQII")  # begin, end, unpacked size, its CRC, length of the compression's name
_PACKED_LENGTH = struct.Struct("<Q")  # behind the compression's name
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data
_RECORD_TYPES: dict[int, type[Channel | Header | Metadata | Schema | Statistics]] = {
    Opcode.CHANNEL: Channel,
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.SCHEMA: Schema,
    Opcode.STATISTICS: Statistics,
}
_CHUNK_RECORDS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_UNREADABLE = (mcap.exceptions.McapError, struct.error, ValueError, OverflowError, MemoryError)
_UNPACKING_ERRORS = (zstandard.ZstdError, RuntimeError, EOFError, MemoryError)


class DamagedError(Exception):
    """A record is damaged; the text explains how."""


def read_chunk_length(head: bytes) -> int:
    """Return the length of a chunk's content in bytes, by the lengths that it states.

    Args:
        head: The first bytes of the content.

    Raises:
        DamagedError: These bytes state no lengths.
    """
    try:
        *_, name_bytes = _CHUNK_HEAD.unpack_from(head)
        (packed_bytes,) = _PACKED_LENGTH.unpack_from(head, _CHUNK_HEAD.size + name_bytes)
    except struct.error:
        raise DamagedError("a chunk whose lengths cannot be") from None
    return _CHUNK_HEAD.size + name_bytes + _PACKED_LENGTH.size + packed_bytes


def unpack_chunk(content: bytes) -> bytearray:
    """Decompress a chunk of an MCAP file, and check its lengths and its checksum.

    Args:
        content: Content of the chunk's record: a header, the name of the compression, and the compressed records.

    Returns:
        The records in the chunk, as bytes.

    Raises:
        DamagedError: The lengths, the compression, the size or the checksum of the chunk is wrong.
    """
    if read_chunk_length(content) != len(content):
        raise DamagedError("a chunk whose lengths contradict each other")
    _, _, unpacked_bytes, expected_crc, name_bytes = _CHUNK_HEAD.unpack_from(content)
    name_end = _CHUNK_HEAD.size + name_bytes
    compression = content[_CHUNK_HEAD.size : name_end]
    compressed = content[name_end + _PACKED_LENGTH.size :]
    if unpacked_bytes > MAX_RECORD_BYTES:
        raise DamagedError(f"a chunk of {unpacked_bytes / 1e6:.0f} MB, more than {MAX_RECORD_BYTES / 1e6:.0f} MB")
    try:
        data = _decompress(compression, compressed, unpacked_bytes)
    except _UNPACKING_ERRORS as error:
        raise DamagedError(f"a chunk that cannot be unpacked ({error})") from None
    if len(data) != unpacked_bytes:
        raise DamagedError(f"a chunk of {len(data)} bytes where {unpacked_bytes} should be")
    has_checksum = expected_crc != 0
    if has_checksum and zlib.crc32(data) != expected_crc:
        raise DamagedError("a chunk whose checksum does not fit")
    return data


def _decompress(compression: bytes, packed: bytes, size: int) -> bytearray:
    """Return the unpacked bytes, but at most `size`. Raises DamagedError for an unknown compression."""
    match compression:
        case b"zstd":
            with zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES).stream_reader(packed) as stream:
                return _read_in_steps(stream.read, size)
        case b"lz4":
            return _decompress_lz4(packed, size)
        case b"":
            return bytearray(packed)
        case _:
            raise DamagedError("a chunk of an unknown compression")


def _decompress_lz4(packed: bytes, size: int) -> bytearray:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    remaining_input = packed  # the decompressor takes all of it in the first step

    def read(max_bytes: int) -> bytes:
        nonlocal remaining_input
        if decompressor.eof:
            return b""
        next_input = remaining_input
        remaining_input = b""
        return decompressor.decompress(next_input, max_length=max_bytes)

    return _read_in_steps(read, size)


def _read_in_steps(read: Callable[[int], bytes], size: int) -> bytearray:
    """Return up to `size` bytes; fewer if the input ends before."""
    data = bytearray()
    while len(data) < size:
        part = read(min(size - len(data), UNPACK_STEP_BYTES))
        if not part:
            break
        data += part
    return data


def parse_chunk(data: bytearray) -> Iterator[McapRecord]:
    """Yield schemas, channels and messages of an unpacked chunk. Raises DamagedError."""
    view = memoryview(data)
    position = 0
    while position < len(data):
        if position + HEAD.size > len(data):
            raise DamagedError("a record that its chunk cuts off")
        opcode, length = HEAD.unpack_from(data, position)
        position += HEAD.size
        if position + length > len(data):
            raise DamagedError("a record that is longer than its chunk")
        if opcode in _CHUNK_RECORDS:
            yield parse_record(opcode, view[position : position + length])
        position += length


def parse_record(opcode: int, content: memoryview) -> McapRecord:
    """Decode the content of one MCAP record, and check that its length is right.

    Args:
        opcode: Kind of the record: a message, channel, header, metadata, schema or statistics.
        content: The bytes behind the record's opcode and length.

    Raises:
        DamagedError: The content cannot be read, or is longer than what it holds.
    """
    if opcode == Opcode.MESSAGE:
        return _parse_message(content)
    stream = ReadDataStream(BytesIO(content))
    try:
        record = _RECORD_TYPES[opcode].read(stream)
    except _UNREADABLE:
        raise DamagedError(f"a record of kind {opcode} that cannot be read") from None
    read_bytes = stream.count
    if read_bytes != len(content):
        raise DamagedError(f"a record of kind {opcode} whose lengths contradict each other")
    return record


def _parse_message(content: memoryview) -> Message:
    if len(content) < _MESSAGE_HEAD.size:
        raise DamagedError("a message without a head")
    channel, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(content)
    return Message(
        channel_id=channel,
        log_time=log_ns,
        data=bytes(content[_MESSAGE_HEAD.size :]),
        publish_time=publish_ns,
        sequence=sequence,
    )
