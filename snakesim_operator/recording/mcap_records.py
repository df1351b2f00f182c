"""Reads single records of an MCAP file, finds the next intact one behind damage, and reads the file's summary.

Source: https://mcap.dev/spec.
"""

import os
import re
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import McapRecord
from mcap.writer import MCAP0_MAGIC

from snakesim_operator.recording.chunks import HEAD, MAX_RECORD_BYTES, DamagedError, parse_record, read_chunk_length
from snakesim_operator.recording.writer import ABOUT

READ_OPCODES = (Opcode.CHANNEL, Opcode.HEADER, Opcode.METADATA, Opcode.SCHEMA, Opcode.MESSAGE)
CUT = "the file ends in the middle of a record"

_FIRST_PRIVATE_OPCODE = 0x80
_END_OF_OPCODES = 0x10
_MESSAGE_INDEX_ENTRY_BYTES = 16

# Searching behind damage.
_SEARCH_BYTES = 1024 * 1024  # read at once
_PATTERN_BYTES = 64  # the longest match of _INTACT_RECORD, and enough of a chunk for its lengths
_INTACT_RECORD = re.compile(  # a chunk of a known compression, a recorder's metadata, or the end of the messages
    rb"\x06[\s\S]{4}\0{4}[\s\S]{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4})[\s\S]{4}\0{4}"
    rb"|\x0c[\s\S]{4}\0{4}\x08\0{3}" + ABOUT.encode() + rb"|\x0f\x04\0{7}[\s\S]{4}[\x01-\x0f]"
)

# The end of a file: DATA_END, the summary, the footer, the magic bytes.
_CRC_BYTES = 4
_DATA_END_HEAD = HEAD.pack(Opcode.DATA_END, _CRC_BYTES)
_FOOTER_CONTENT_BYTES = 20  # two offsets and a CRC
_FOOTER_HEAD = HEAD.pack(Opcode.FOOTER, _FOOTER_CONTENT_BYTES)
_FOOTER_BYTES = HEAD.size + _FOOTER_CONTENT_BYTES + len(MCAP0_MAGIC)
_SUMMARY_OPCODES = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)


class RawRecord(NamedTuple):
    """A record that is not decoded."""

    opcode: int
    content: bytes  # empty for a record that is skipped
    end: int  # position of the next record


def read_record(file: BinaryIO, position: int, size: int) -> RawRecord:
    """Read the record at a position of a file.

    Args:
        file: The file.
        position: In bytes from its beginning.
        size: Size of the file in bytes.

    Raises:
        DamagedError: There is no intact record.
        OSError: The file cannot be read.
    """
    file.seek(position)
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        raise DamagedError(CUT)
    opcode, length = HEAD.unpack(head)
    begin = position + HEAD.size
    end = begin + length
    if not 0 < opcode < _END_OF_OPCODES and opcode < _FIRST_PRIVATE_OPCODE:
        raise DamagedError("no record")
    if end > size:
        raise DamagedError(CUT)
    _check_length(file, begin, opcode, length)
    if opcode != Opcode.CHUNK and opcode not in READ_OPCODES:
        return RawRecord(opcode, b"", end)
    if length > MAX_RECORD_BYTES:
        raise DamagedError(f"a record of {length / 1e6:.0f} MB, more than {MAX_RECORD_BYTES / 1e6:.0f} MB")
    file.seek(begin)
    content = file.read(length)
    if len(content) != length:
        raise DamagedError(CUT)
    return RawRecord(opcode, content, end)


def _check_length(file: BinaryIO, begin: int, opcode: int, length: int) -> None:
    """Compare the length in a record's head with the lengths in its content, where it has some. Raises DamagedError."""
    match opcode:
        case Opcode.CHUNK:
            file.seek(begin)
            if length != read_chunk_length(file.read(_PATTERN_BYTES)):
                raise DamagedError("a chunk whose lengths contradict each other")
        case Opcode.MESSAGE_INDEX:
            file.seek(begin)
            index_head = file.read(6)  # channel number, then the length of the entries
            entry_bytes = int.from_bytes(index_head[2:], "little")
            if length != 6 + entry_bytes or entry_bytes % _MESSAGE_INDEX_ENTRY_BYTES != 0:
                raise DamagedError("an index whose lengths contradict each other")
        case Opcode.DATA_END:
            if length != _CRC_BYTES:
                raise DamagedError("an end that is none")
        case _:
            pass


def find_next_record(file: BinaryIO, position: int, size: int) -> int | None:
    """Return the position of the next intact record at which reading can continue; None if there is none.

    Raises OSError.
    """
    while position < size:
        file.seek(position)
        block = file.read(_SEARCH_BYTES + _PATTERN_BYTES)
        for candidate in _find_candidates(block):
            try:
                read_record(file, position + candidate, size)
            except DamagedError:
                continue
            return position + candidate
        position += _SEARCH_BYTES
    return None


def _find_candidates(block: bytes) -> Iterator[int]:
    """Yield the offsets within the first _SEARCH_BYTES of a block at which a record may begin; they may overlap."""
    begin = 0
    while True:
        match = _INTACT_RECORD.search(block, begin)
        if match is None or match.start() >= _SEARCH_BYTES:
            return
        yield match.start()
        begin = match.start() + 1


def read_summary(file: BinaryIO) -> list[McapRecord]:
    """Return channels, schemas and statistics at the end of a file.

    Raises:
        DamagedError: The file has no intact end.
        OSError: The file cannot be read.
    """
    summary = _read_summary_bytes(file)
    view = memoryview(summary)
    records: list[McapRecord] = []
    position = 0
    while position + HEAD.size <= len(summary):
        opcode, length = HEAD.unpack_from(summary, position)
        position += HEAD.size
        if opcode in _SUMMARY_OPCODES:
            if position + length > len(summary):
                raise DamagedError("a summary whose lengths contradict each other")
            records.append(parse_record(opcode, view[position : position + length]))
        position += length
    return records


def _read_summary_bytes(file: BinaryIO) -> bytes:
    """Return the summary of a file whose checksum is right. Raises DamagedError, OSError."""
    size = file.seek(0, os.SEEK_END)
    if size <= _FOOTER_BYTES:
        raise DamagedError(CUT)
    file.seek(size - _FOOTER_BYTES)
    footer = file.read(_FOOTER_BYTES)
    if not footer.endswith(MCAP0_MAGIC) or footer[: HEAD.size] != _FOOTER_HEAD:
        raise DamagedError(CUT)
    stated_begin = int.from_bytes(footer[9:17], "little")
    crc = int.from_bytes(footer[25:29], "little")
    tail_begin = max(size - _FOOTER_BYTES - MAX_RECORD_BYTES, 0)
    file.seek(tail_begin)
    tail = file.read(size - _FOOTER_BYTES - tail_begin)
    # The summary begins where the footer states it, or, if a part of the file is gone, behind the last DATA_END.
    behind_data_end = tail.rfind(_DATA_END_HEAD) + len(_DATA_END_HEAD) + _CRC_BYTES
    for begin in (stated_begin - tail_begin, behind_data_end):
        summary = b""
        if 0 < begin <= len(tail):
            summary = tail[begin:]
        if crc and zlib.crc32(footer[:25], zlib.crc32(summary)) == crc:
            return summary
    raise DamagedError("a summary whose checksum does not fit")
