"""PNG without a library for pictures: lossless, by zlib alone. Source: W3C, Portable Network Graphics (PNG)."""

import struct
import zlib

QUICK = 1  # zlib's level: a picture of a second ago is of no use
SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, RGB = 0, 2  # color types


def png(width: int, height: int, pixels: bytes, *, bits: int, color: bool) -> bytes:
    """A picture of rows without padding, from the top; bits: of a channel, 8 or 16, the latter big endian."""
    stride = width * (3 if color else 1) * bits // 8
    rows = b"".join(b"\0" + pixels[i * stride : (i + 1) * stride] for i in range(height))  # 0: not filtered
    header = struct.pack(">IIBBBBB", width, height, bits, RGB if color else GREY, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, QUICK)), (b"IEND", b""))
    return SIGNATURE + b"".join(_chunk(name, data) for name, data in chunks)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
