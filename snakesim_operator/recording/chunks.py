"""Records of an MCAP file, unpacked within bounds: nothing is allocated because a header claims it. Pure.

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

LARGEST_BYTES = 64 * 1024 * 1024  # of a record, and of what is unpacked of a chunk: ours have 1 MB, and an image
_STEP_BYTES = 1024 * 1024
HEAD = struct.Struct("<BQ")  # opcode and length of every record
_CHUNK = struct.Struct("<QQQII")  # begin, end, unpacked size, its CRC, length of the compression's name
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data
_PARSERS: dict[int, type[Channel | Header | Metadata | Schema | Statistics]] = {
    Opcode.CHANNEL: Channel,
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.SCHEMA: Schema,
    Opcode.STATISTICS: Statistics,
}
_UNREADABLE = (mcap.exceptions.McapError, struct.error, ValueError, OverflowError, MemoryError)


class DamagedError(Exception):
    """A record that is not what it must be; says why."""


def chunk_bytes(head: bytes) -> int:
    """Length of a chunk's content by the lengths within it. head: the first bytes of it. Raises DamagedError."""
    try:
        width = _CHUNK.unpack_from(head)[-1]
        (packed,) = struct.unpack_from("<Q", head, _CHUNK.size + width)
    except struct.error:
        raise DamagedError("a chunk whose lengths cannot be") from None
    return _CHUNK.size + width + 8 + packed


def unpack(content: bytes) -> bytearray:
    """What is in a chunk. Raises DamagedError."""
    if chunk_bytes(content) != len(content):
        raise DamagedError("a chunk whose lengths contradict each other")
    _, _, size, crc, width = _CHUNK.unpack_from(content)
    name, packed = content[_CHUNK.size : _CHUNK.size + width], content[_CHUNK.size + width + 8 :]
    if size > LARGEST_BYTES:
        raise DamagedError(f"a chunk of {size / 1e6:.0f} MB, more than {LARGEST_BYTES / 1e6:.0f} MB")
    try:
        data = _unpacked(name, packed, size)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise DamagedError(f"a chunk that cannot be unpacked ({error})") from None
    if len(data) != size:
        raise DamagedError(f"a chunk of {len(data)} bytes where {size} should be")
    if crc and zlib.crc32(data) != crc:
        raise DamagedError("a chunk whose checksum does not fit")
    return data


def _unpacked(name: bytes, packed: bytes, size: int) -> bytearray:
    if name == b"zstd":
        with zstandard.ZstdDecompressor(max_window_size=LARGEST_BYTES).stream_reader(packed) as stream:
            return _in_steps(stream.read, size)
    if name == b"lz4":
        unpacker, given = lz4.frame.LZ4FrameDecompressor(), iter((packed,))

        def read(most: int) -> bytes:
            return b"" if unpacker.eof else unpacker.decompress(next(given, b""), max_length=most)

        return _in_steps(read, size)
    if name:
        raise DamagedError("a chunk of an unknown compression")
    return bytearray(packed)


def _in_steps(read: Callable[[int], bytes], size: int) -> bytearray:
    found = bytearray()
    while len(found) < size and (part := read(min(size - len(found), _STEP_BYTES))):
        found += part
    return found


def records_in(data: bytearray) -> Iterator[McapRecord]:
    """Schemas, channels and messages of an unpacked chunk. Raises DamagedError."""
    view, at = memoryview(data), 0
    while at < len(data):
        if at + HEAD.size > len(data):
            raise DamagedError("a record that its chunk cuts off")
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if at + length > len(data):
            raise DamagedError("a record that is longer than its chunk")
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield parsed(opcode, view[at : at + length])
        at += length


def parsed(opcode: int, content: memoryview) -> McapRecord:
    """A record that is read. Raises DamagedError, also when it is longer than what it holds."""
    if opcode == Opcode.MESSAGE:
        if len(content) < _MESSAGE.size:
            raise DamagedError("a message without a head")
        channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
        return Message(channel, log_ns, bytes(content[_MESSAGE.size :]), publish_ns, sequence)
    stream = ReadDataStream(BytesIO(content))
    try:
        record = _PARSERS[opcode].read(stream)
    except _UNREADABLE:
        raise DamagedError(f"a record of kind {opcode} that cannot be read") from None
    if stream.count != len(content):
        raise DamagedError(f"a record of kind {opcode} whose lengths contradict each other")
    return record
