"""CDR, the encoding of ROS 2 messages: plain XCDR version 1, little endian (OMG DDSI-RTPS 2.5, 10; fastcdr's DDS_CDR).

Four bytes of header, then the fields in order; a number lies at a multiple of its size, counted from behind the header.
"""

import struct
from collections.abc import Sequence

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
HEADER_BYTES = len(LITTLE_ENDIAN)


class Cdr:
    """Writes one message. Kinds of numbers are those of `struct`: b B h H i I q Q f d, and ? for a flag."""

    def __init__(self) -> None:
        self._out = bytearray(LITTLE_ENDIAN)

    def numbers(self, kind: str, *values: float) -> "Cdr":
        """Numbers of one kind, one after the other."""
        if values:
            self._out += bytes((HEADER_BYTES - len(self._out)) % struct.calcsize(kind))
            self._out += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, value: str) -> "Cdr":
        """A string; its length counts the zero at its end."""
        raw = value.encode()
        self.numbers("I", len(raw) + 1)
        self._out += raw + b"\0"
        return self

    def texts(self, values: Sequence[str]) -> "Cdr":
        """A sequence of strings."""
        self.numbers("I", len(values))
        for value in values:
            self.text(value)
        return self

    def sequence(self, kind: str, values: Sequence[float]) -> "Cdr":
        """A sequence of numbers."""
        return self.numbers("I", len(values)).numbers(kind, *values)

    def octets(self, raw: bytes) -> "Cdr":
        """A sequence of bytes, as images have."""
        self.numbers("I", len(raw))
        self._out += raw
        return self

    def done(self) -> bytes:
        """The whole message."""
        return bytes(self._out)


def six_doubles(payload: bytes) -> tuple[float, ...] | None:
    """A message of six float64, such as a Twist, of either byte order; None: it is none."""
    if len(payload) < HEADER_BYTES + 48 or payload[0] != 0 or payload[1] not in (0, 1):
        return None
    return struct.unpack_from("<6d" if payload[1] else ">6d", payload, HEADER_BYTES)
