"""Writes PNG images with zlib alone, lossless. Source: W3C, Portable Network Graphics (PNG) Specification."""

import struct
import zlib

COMPRESSION_LEVEL = 1  # the fastest: images are shown live
SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, RGB = 0, 2  # color types
NO_FILTER = b"\0"  # precedes each row


def encode_png(width: int, height: int, pixels: bytes, *, bits: int, color: bool) -> bytes:
    """Encode an image as PNG, without a library.

    Args:
        width: Width in pixels.
        height: Height in pixels.
        pixels: Rows of pixels from the top, without padding.
        bits: Bits per channel, 8 or 16; with 16, the bytes are big endian.
        color: Whether a pixel has the channels red, green and blue; otherwise it has one gray channel.

    Returns:
        The content of the file.
    """
    channels = 3 if color else 1
    row_bytes = width * channels * bits // 8
    rows = [pixels[i * row_bytes : (i + 1) * row_bytes] for i in range(height)]
    filtered = b"".join(NO_FILTER + row for row in rows)
    compression = filtering = interlacing = 0  # the only standard methods; not interlaced
    header = struct.pack(
        ">IIBBBBB", width, height, bits, RGB if color else GREY, compression, filtering, interlacing
    )
    return b"".join(
        [
            SIGNATURE,
            _encode_chunk(b"IHDR", header),
            _encode_chunk(b"IDAT", zlib.compress(filtered, COMPRESSION_LEVEL)),
            _encode_chunk(b"IEND", b""),
        ]
    )


def _encode_chunk(name: bytes, data: bytes) -> bytes:
    """Encode a PNG chunk: length, name, data and checksum."""
    checksum = zlib.crc32(name + data)
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)
