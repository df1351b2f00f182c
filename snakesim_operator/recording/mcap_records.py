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
_MESSAGE_INDEX_HEAD_BYTES = 6  # channel number (2 bytes), then the length of the entries (4 bytes)
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
    """Read the MCAP record at a position of a file. Its content is read only if a reader needs it.

    Args:
        file: The file.
        position: Position of the record, in bytes from the beginning of the file.
        size: Size of the file in bytes.

    Returns:
        The record. Its content is empty if its kind is neither a chunk nor one of READ_OPCODES.

    Raises:
        DamagedError: There is no intact record at this position.
        OSError: The file cannot be read.
    """
    file.seek(position)
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        raise DamagedError(CUT)
    opcode, content_length = HEAD.unpack(head)
    content_begin = position + HEAD.size
    record_end = content_begin + content_length
    is_known = 0 < opcode < _END_OF_OPCODES
    is_private = opcode >= _FIRST_PRIVATE_OPCODE
    if not is_known and not is_private:
        raise DamagedError("no record")
    if record_end > size:
        raise DamagedError(CUT)
    _check_length(file, content_begin, opcode, content_length)

    is_needed = opcode == Opcode.CHUNK or opcode in READ_OPCODES
    if not is_needed:
        return RawRecord(opcode, b"", record_end)
    if content_length > MAX_RECORD_BYTES:
        raise DamagedError(f"a record of {content_length / 1e6:.0f} MB, more than {MAX_RECORD_BYTES / 1e6:.0f} MB")
    file.seek(content_begin)
    content = file.read(content_length)
    if len(content) != content_length:
        raise DamagedError(CUT)
    return RawRecord(opcode, content, record_end)


def _check_length(file: BinaryIO, begin: int, opcode: int, length: int) -> None:
    """Check the length that a record's head states against the lengths in its content.

    Only chunks, message indexes and the end of the data state or have a known length; other kinds pass.

    Args:
        file: The file; its position changes.
        begin: Position of the record's content.
        opcode: Kind of the record.
        length: Length of the content in bytes, as the head states it.

    Raises:
        DamagedError: The lengths contradict each other.
        OSError: The file cannot be read.
    """
    match opcode:
        case Opcode.CHUNK:
            file.seek(begin)
            content_start = file.read(_PATTERN_BYTES)
            if length != read_chunk_length(content_start):
                raise DamagedError("a chunk whose lengths contradict each other")
        case Opcode.MESSAGE_INDEX:
            file.seek(begin)
            index_head = file.read(_MESSAGE_INDEX_HEAD_BYTES)
            entries_bytes = int.from_bytes(index_head[2:], "little")
            is_whole_entries = entries_bytes % _MESSAGE_INDEX_ENTRY_BYTES == 0
            if length != _MESSAGE_INDEX_HEAD_BYTES + entries_bytes or not is_whole_entries:
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
    """Return the copies of channels, schemas and statistics in the summary at the end of an MCAP file.

    Args:
        file: The file; its position changes.

    Raises:
        DamagedError: The file has no intact end.
        OSError: The file cannot be read.
    """
    summary = _read_summary_bytes(file)
    view = memoryview(summary)
    records: list[McapRecord] = []
    position = 0
    while position + HEAD.size <= len(summary):
        opcode, content_length = HEAD.unpack_from(summary, position)
        content_begin = position + HEAD.size
        content_end = content_begin + content_length
        if opcode in _SUMMARY_OPCODES:
            if content_end > len(summary):
                raise DamagedError("a summary whose lengths contradict each other")
            records.append(parse_record(opcode, view[content_begin:content_end]))
        position = content_end
    return records


def _read_summary_bytes(file: BinaryIO) -> bytes:
    """Return the summary section of an MCAP file: the records between the end of the data and the footer.

    The footer states where the summary begins, and a checksum of both. If bytes are missing in the middle of the file,
    the stated position is wrong; then the summary is looked for behind the last DATA_END record.

    Raises:
        DamagedError: The file has no footer, or no summary fits its checksum.
        OSError: The file cannot be read.
    """
    size = file.seek(0, os.SEEK_END)
    footer_position = size - _FOOTER_BYTES
    if footer_position <= 0:
        raise DamagedError(CUT)
    file.seek(footer_position)
    footer = file.read(_FOOTER_BYTES)
    if not footer.endswith(MCAP0_MAGIC) or footer[: HEAD.size] != _FOOTER_HEAD:
        raise DamagedError(CUT)
    # Content of the footer: begin of the summary (8 bytes), begin of its offsets (8 bytes), checksum (4 bytes).
    footer_before_crc = footer[:25]
    stated_position = int.from_bytes(footer[9:17], "little")
    expected_crc = int.from_bytes(footer[25:29], "little")

    # A summary that is larger than MAX_RECORD_BYTES is not read.
    tail_position = max(footer_position - MAX_RECORD_BYTES, 0)
    file.seek(tail_position)
    tail = file.read(footer_position - tail_position)
    stated_begin = stated_position - tail_position
    begin_after_data = tail.rfind(_DATA_END_HEAD) + len(_DATA_END_HEAD) + _CRC_BYTES
    for begin in (stated_begin, begin_after_data):
        summary = b""
        if 0 < begin <= len(tail):
            summary = tail[begin:]
        actual_crc = zlib.crc32(footer_before_crc, zlib.crc32(summary))
        if expected_crc and actual_crc == expected_crc:
            return summary
    raise DamagedError("a summary whose checksum does not fit")
