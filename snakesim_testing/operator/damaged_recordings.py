"""A recording of many chunks, and copies of it that are damaged in one known way."""

import zlib
from dataclasses import dataclass
from pathlib import Path

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.recording import mcap_file, writer
from snakesim_operator.recording.chunks import RECORD_HEADER
from snakesim_operator.run.in_process import simulate


@dataclass(frozen=True)
class RecordSpan:
    """A record of the file."""

    opcode: int
    begin: int
    end: int


def spans(content: bytes | bytearray, magic: int = 8) -> list[RecordSpan]:
    """All records of a whole file; or of a chunk, which has no magic bytes around them."""
    found, at = list[RecordSpan](), magic
    while at < len(content) - magic:
        opcode, length = RECORD_HEADER.unpack_from(content, at)
        found.append(RecordSpan(opcode, at, at + RECORD_HEADER.size + length))
        at = found[-1].end
    return found


def chunks(content: bytes) -> list[RecordSpan]:
    """The chunks of a whole file, without their indices."""
    return [span for span in spans(content) if span.opcode == Opcode.CHUNK]


def flipped(content: bytes, at: int) -> bytes:
    """With one bit changed."""
    return content[:at] + bytes([content[at] ^ 0x10]) + content[at + 1 :]


def recorded(out: Path, duration_s: float, chunk_bytes: int) -> Path:
    """A short run, in many small chunks as a long recording has them."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(mcap_file, "CHUNK_BYTES", chunk_bytes)
        patched.setattr(writer, "FLUSH_S", 3600.0)  # chunks by size alone, however busy the machine
        simulate(
            load_scenario("peg_row", [parse_set_option(f"duration_s={duration_s}")]).config, out
        )
    return out


def packed(content: bytes, compression: str = "zstd", data: bytes | None = None) -> bytes:
    """A chunk record. data: in place of the compressed content."""
    builder = RecordBuilder()
    body = zstandard.compress(content) if data is None else data
    Chunk(compression, body, 0, 0, zlib.crc32(content), len(content)).write(builder)
    return builder.end()


def written(path: Path, content: bytes) -> Path:
    """The file."""
    path.write_bytes(content)
    return path
