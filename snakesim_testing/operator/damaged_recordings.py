"""Makes a short recording of many chunks, finds the MCAP records in it, and damages it in a known way."""

import zlib
from dataclasses import dataclass
from pathlib import Path

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.recording import writer
from snakesim_operator.recording.mcap_format import file_writer
from snakesim_operator.recording.mcap_format.chunks import RECORD_HEADER
from snakesim_operator.run.in_process import simulate

FLIPPED_BIT = 0x10  # of the byte in which `flip_bit` changes a bit
NEVER_FLUSH_S = 3600.0  # longer than any recording of a test


@dataclass(frozen=True)
class RecordSpan:
    """The bytes of one MCAP record, from the first byte of its header to the byte behind its content."""

    opcode: int
    begin: int
    end: int


def list_records(
    content: bytes | bytearray, magic_bytes: int = len(MCAP0_MAGIC)
) -> list[RecordSpan]:
    """Find all records in an undamaged file or chunk.

    Args:
        content: The bytes of a file, or the unpacked bytes of a chunk.
        magic_bytes: The length of the magic at both ends, which is 0 for a chunk.
    """
    records: list[RecordSpan] = []
    position = magic_bytes
    while position < len(content) - magic_bytes:
        opcode, length = RECORD_HEADER.unpack_from(content, position)
        record = RecordSpan(opcode, position, position + RECORD_HEADER.size + length)
        records.append(record)
        position = record.end
    return records


def list_chunks(content: bytes) -> list[RecordSpan]:
    """Find the chunks of an undamaged file, without their indices."""
    return [record for record in list_records(content) if record.opcode == Opcode.CHUNK]


def flip_bit(content: bytes, position: int) -> bytes:
    """Return the content with one bit changed in the byte at `position`."""
    changed_byte = content[position] ^ FLIPPED_BIT
    return content[:position] + bytes([changed_byte]) + content[position + 1 :]


def record_short_run(folder: Path, duration_s: float, chunk_bytes: int) -> Path:
    """Record a short run in many small chunks, as a long recording has them. Returns the folder of the run."""
    duration = parse_set_option(f"duration_s={duration_s}")
    config = load_scenario("peg_row", [duration]).config
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(file_writer, "CHUNK_BYTES", chunk_bytes)
        # Only the size ends a chunk then, however busy the machine is.
        patched.setattr(writer, "FLUSH_S", NEVER_FLUSH_S)
        simulate(config, folder)
    return folder


def make_chunk_record(
    content: bytes, compression: str = "zstd", packed_content: bytes | None = None
) -> bytes:
    """Make the bytes of a chunk record.

    Args:
        content: The unpacked content, of which the record states the length and the checksum.
        compression: The name of the compression that the record states.
        packed_content: Bytes that take the place of the compressed content.
    """
    if packed_content is None:
        packed_content = zstandard.compress(content)
    chunk = Chunk(
        compression=compression,
        data=packed_content,
        message_start_time=0,
        message_end_time=0,
        uncompressed_crc=zlib.crc32(content),
        uncompressed_size=len(content),
    )
    builder = RecordBuilder()
    chunk.write(builder)
    return builder.end()


def write_file(path: Path, content: bytes) -> Path:
    """Write the content into a file, and return its path."""
    path.write_bytes(content)
    return path
