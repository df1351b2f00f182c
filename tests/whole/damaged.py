"""Copies of a recording that are damaged in one known way."""

import struct
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

HEAD = struct.Struct("<BQ")


@dataclass(frozen=True)
class Span:
    """A record of the file."""

    opcode: int
    begin: int
    end: int


def spans(content: bytes) -> list[Span]:
    """All records of a whole file."""
    found, at = list[Span](), 8
    while at < len(content) - 8:
        opcode, length = HEAD.unpack_from(content, at)
        found.append(Span(opcode, at, at + HEAD.size + length))
        at = found[-1].end
    return found


def chunks(content: bytes) -> list[Span]:
    """The chunks of a whole file, without their indices."""
    return [span for span in spans(content) if span.opcode == Opcode.CHUNK]


def flipped(content: bytes, at: int) -> bytes:
    """With one bit changed."""
    return content[:at] + bytes([content[at] ^ 0x10]) + content[at + 1 :]


def written(path: Path, content: bytes) -> Path:
    """The file."""
    path.write_bytes(content)
    return path
