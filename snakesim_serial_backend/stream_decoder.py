"""Finds packets in a stream of bytes, for protocols whose packets begin with a header and their length. Pure."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar, Generic, TypeVar

PacketT = TypeVar("PacketT")


class StreamDecoder(ABC, Generic[PacketT]):
    """Finds packets in a stream of bytes. Noise and damaged packets are skipped."""

    header: ClassVar[bytes]
    bytes_before: ClassVar[int]  # of a packet, after which its length is known

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.skipped = 0  # bytes

    @abstractmethod
    def read_length(self, start: bytes) -> int | None:
        """Return the length of a packet in bytes, or None if it is impossible.

        Args:
            start: The first `bytes_before` bytes of the packet, which begin with the header.
        """

    @abstractmethod
    def decode(self, data: bytes) -> PacketT | None:
        """Return the packet that these bytes are; None if they are damaged."""

    def feed(self, data: bytes) -> Iterator[PacketT]:
        """Add received bytes, and yield the packets that are complete now."""
        self._bytes += data
        while True:
            self._skip_to_header()
            length = self._find_length()
            if length is None or len(self._bytes) < length:
                return
            packet = self.decode(bytes(self._bytes[:length]))
            if packet is None:
                self._skip(1)
            else:
                del self._bytes[:length]
                yield packet

    @property
    def garbled(self) -> bool:
        """Whether bytes have arrived that are no packet."""
        return self.skipped > 0 or len(self._bytes) > 0

    def _skip_to_header(self) -> None:
        """Skip bytes up to the next header, or up to bytes that may be the start of one."""
        start = self._bytes.find(self.header)
        if start < 0:
            start = max(len(self._bytes) - len(self.header) + 1, 0)
        self._skip(start)

    def _find_length(self) -> int | None:
        """Return the length of the packet at the start of the bytes; None if more bytes are needed to know it.

        A header that is followed by an impossible length is skipped.
        """
        while len(self._bytes) >= self.bytes_before and self._bytes.startswith(self.header):
            length = self.read_length(bytes(self._bytes[: self.bytes_before]))
            if length is not None:
                return length
            self._skip(1)
            self._skip_to_header()
        return None

    def _skip(self, count: int) -> None:
        self.skipped += count
        del self._bytes[:count]
