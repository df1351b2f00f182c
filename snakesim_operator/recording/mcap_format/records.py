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

from snakesim_operator.recording.mcap_format.chunks import (
    MAX_RECORD_BYTES,
    RECORD_HEADER,
    CorruptFileError,
    parse_record,
    read_chunk_length,
)
from snakesim_operator.recording.mcap_format.file_writer import METADATA_NAME

OPCODES_TO_READ = (Opcode.CHANNEL, Opcode.HEADER, Opcode.METADATA, Opcode.SCHEMA, Opcode.MESSAGE)
TRUNCATED = "the file ends in the middle of a record"

_FIRST_PRIVATE_OPCODE = 0x80
_FIRST_UNDEFINED_OPCODE = 0x10
# Channel number (2 bytes), then the length of the entries (4 bytes).
_MESSAGE_INDEX_HEADER_BYTES = 6
_MESSAGE_INDEX_ENTRY_BYTES = 16

# Searching behind damage.
_SEARCH_BLOCK_BYTES = 1024 * 1024  # read at once
# The longest match of _RECORD_START_PATTERN, and enough of a chunk for its lengths.
_MAX_PATTERN_BYTES = 64
_RECORD_START_PATTERN = (
    re.compile(  # a chunk of a known compression, a recorder's metadata, or the end of the messages
        rb"\x06[\s\S]{4}\0{4}[\s\S]{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4})[\s\S]{4}\0{4}"
        rb"|\x0c[\s\S]{4}\0{4}\x08\0{3}"
        + METADATA_NAME.encode()
        + rb"|\x0f\x04\0{7}[\s\S]{4}[\x01-\x0f]"
    )
)

# The end of a file: DATA_END, the summary, the footer, the magic bytes.
_CRC_BYTES = 4
_DATA_END_HEADER = RECORD_HEADER.pack(Opcode.DATA_END, _CRC_BYTES)
_FOOTER_CONTENT_BYTES = 20  # two offsets and a CRC
_FOOTER_HEADER = RECORD_HEADER.pack(Opcode.FOOTER, _FOOTER_CONTENT_BYTES)
_FOOTER_BYTES = RECORD_HEADER.size + _FOOTER_CONTENT_BYTES + len(MCAP0_MAGIC)
_SUMMARY_OPCODES = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)


class RawRecord(NamedTuple):
    """A record that is not decoded."""

    opcode: int
    content: bytes  # empty for a record that is skipped
    end: int  # position of the next record


def read_record(file: BinaryIO, position: int, file_size: int) -> RawRecord:
    """Read the MCAP record at a position of a file. Its content is read only if a reader needs it.

    Args:
        file: The file.
        position: Position of the record, in bytes from the beginning of the file.
        file_size: Size of the file in bytes.

    Returns:
        The record. Its content is empty if its kind is neither a chunk nor one of OPCODES_TO_READ.

    Raises:
        CorruptFileError: There is no intact record at this position.
        OSError: The file cannot be read.
    """
    file.seek(position)
    header = file.read(RECORD_HEADER.size)
    if len(header) < RECORD_HEADER.size:
        raise CorruptFileError(TRUNCATED)
    opcode, content_length = RECORD_HEADER.unpack(header)
    content_start = position + RECORD_HEADER.size
    record_end = content_start + content_length
    is_known = 0 < opcode < _FIRST_UNDEFINED_OPCODE
    is_private = opcode >= _FIRST_PRIVATE_OPCODE
    if not is_known and not is_private:
        raise CorruptFileError("no record")
    if record_end > file_size:
        raise CorruptFileError(TRUNCATED)
    _validate_content_length(file, content_start, opcode, content_length)

    is_needed = opcode == Opcode.CHUNK or opcode in OPCODES_TO_READ
    if not is_needed:
        return RawRecord(opcode, b"", record_end)
    if content_length > MAX_RECORD_BYTES:
        raise CorruptFileError(
            f"a record of {content_length / 1e6:.0f} MB, more than {MAX_RECORD_BYTES / 1e6:.0f} MB"
        )
    file.seek(content_start)
    content = file.read(content_length)
    if len(content) != content_length:
        raise CorruptFileError(TRUNCATED)
    return RawRecord(opcode, content, record_end)


def _validate_content_length(
    file: BinaryIO, content_start: int, opcode: int, stated_length: int
) -> None:
    """Check the content length in a record's header against the lengths that the content itself states.

    The content of chunks and message indexes states its length, and the content of DATA_END has a fixed length. Other
    kinds of records are not checked.

    Args:
        file: The file; its position changes.
        content_start: Position of the record's content, in bytes from the beginning of the file.
        opcode: Kind of the record.
        stated_length: Length of the content in bytes, as the header of the record states it.

    Raises:
        CorruptFileError: The lengths contradict each other.
        OSError: The file cannot be read.
    """
    match opcode:
        case Opcode.CHUNK:
            file.seek(content_start)
            content_prefix = file.read(_MAX_PATTERN_BYTES)
            if stated_length != read_chunk_length(content_prefix):
                raise CorruptFileError("a chunk whose lengths contradict each other")
        case Opcode.MESSAGE_INDEX:
            file.seek(content_start)
            index_header = file.read(_MESSAGE_INDEX_HEADER_BYTES)
            entries_bytes = int.from_bytes(index_header[2:], "little")
            is_whole_entries = entries_bytes % _MESSAGE_INDEX_ENTRY_BYTES == 0
            if stated_length != _MESSAGE_INDEX_HEADER_BYTES + entries_bytes or not is_whole_entries:
                raise CorruptFileError("an index whose lengths contradict each other")
        case Opcode.DATA_END:
            if stated_length != _CRC_BYTES:
                raise CorruptFileError("an end that is none")
        case _:
            pass


def find_next_record(file: BinaryIO, position: int, file_size: int) -> int | None:
    """Find the next intact record at which reading can continue after damage.

    Args:
        file: The file; its position changes.
        position: Position at which the search starts, in bytes from the beginning of the file.
        file_size: Size of the file in bytes.

    Returns:
        The position of the record, or None if there is no intact record.

    Raises:
        OSError: The file cannot be read.
    """
    while position < file_size:
        file.seek(position)
        block = file.read(_SEARCH_BLOCK_BYTES + _MAX_PATTERN_BYTES)
        for offset in _find_possible_record_offsets(block):
            try:
                read_record(file, position + offset, file_size)
            except CorruptFileError:
                continue
            return position + offset
        position += _SEARCH_BLOCK_BYTES
    return None


def _find_possible_record_offsets(block: bytes) -> Iterator[int]:
    """Yield the offsets at which a record may begin, within the first _SEARCH_BLOCK_BYTES of a block.

    The found patterns may overlap, so that an accidental match hides no record.
    """
    search_start = 0
    while True:
        match = _RECORD_START_PATTERN.search(block, search_start)
        if match is None or match.start() >= _SEARCH_BLOCK_BYTES:
            return
        yield match.start()
        search_start = match.start() + 1


def read_summary(file: BinaryIO) -> list[McapRecord]:
    """Return the copies of channels, schemas and statistics in the summary at the end of an MCAP file.

    Args:
        file: The file; its position changes.

    Raises:
        CorruptFileError: The file has no intact end.
        OSError: The file cannot be read.
    """
    summary = _read_summary_bytes(file)
    view = memoryview(summary)
    records: list[McapRecord] = []
    position = 0
    while position + RECORD_HEADER.size <= len(summary):
        opcode, content_length = RECORD_HEADER.unpack_from(summary, position)
        content_start = position + RECORD_HEADER.size
        content_end = content_start + content_length
        if opcode in _SUMMARY_OPCODES:
            if content_end > len(summary):
                raise CorruptFileError("a summary whose lengths contradict each other")
            records.append(parse_record(opcode, view[content_start:content_end]))
        position = content_end
    return records


def _read_summary_bytes(file: BinaryIO) -> bytes:
    """Return the summary section of an MCAP file: the records between the end of the data and the footer.

    The footer states where the summary begins, and a checksum of both. If bytes are missing in the middle of the file,
    the stated position is wrong; then the summary is looked for behind the last DATA_END record.

    Raises:
        CorruptFileError: The file has no footer, or no summary fits its checksum.
        OSError: The file cannot be read.
    """
    file_size = file.seek(0, os.SEEK_END)
    footer_position = file_size - _FOOTER_BYTES
    if footer_position <= 0:
        raise CorruptFileError(TRUNCATED)
    file.seek(footer_position)
    footer = file.read(_FOOTER_BYTES)
    if not footer.endswith(MCAP0_MAGIC) or footer[: RECORD_HEADER.size] != _FOOTER_HEADER:
        raise CorruptFileError(TRUNCATED)
    # Content of the footer: begin of the summary (8 bytes), begin of its offsets (8 bytes), checksum (4 bytes).
    footer_before_crc = footer[:25]
    stated_position = int.from_bytes(footer[9:17], "little")
    expected_crc = int.from_bytes(footer[25:29], "little")

    # A summary that is larger than MAX_RECORD_BYTES is not read.
    tail_start = max(footer_position - MAX_RECORD_BYTES, 0)
    file.seek(tail_start)
    tail = file.read(footer_position - tail_start)
    stated_start = stated_position - tail_start
    start_after_data = tail.rfind(_DATA_END_HEADER) + len(_DATA_END_HEADER) + _CRC_BYTES
    for summary_start in (stated_start, start_after_data):
        summary = b""
        if 0 < summary_start <= len(tail):
            summary = tail[summary_start:]
        actual_crc = zlib.crc32(footer_before_crc, zlib.crc32(summary))
        if expected_crc and actual_crc == expected_crc:
            return summary
    raise CorruptFileError("a summary whose checksum does not fit")
