"""A file that grows: its bytes stay in memory until `flush`, and a full disk leaves it as it was at the last flush."""

import contextlib
import errno
import os
from pathlib import Path


class GrowingFile:
    """The part of a file that an MCAP writer needs. After the creation, only `flush` raises OSError."""

    def __init__(self, path: Path) -> None:
        """Create the file. Raises OSError; FileExistsError if the file exists."""
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._written_bytes = 0
        self._waiting = bytearray()

    @property
    def waiting_bytes(self) -> int:
        """Return the number of bytes that the disk does not have."""
        return len(self._waiting)

    def write(self, data: bytes) -> int:
        """Add bytes, and return their number."""
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        """Return the position of the next byte."""
        return self._written_bytes + len(self._waiting)

    def flush(self) -> None:
        """Write the buffered bytes to the disk: either all of them, or none.

        Raises:
            OSError: The disk does not take all of them. The file then ends where it ended before, and the buffered
                bytes are lost.
        """
        written_count = 0
        try:
            while written_count < len(self._waiting):
                count = os.write(self._handle, self._waiting[written_count:])
                if count == 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                written_count += count
        except OSError:
            self._cut_back()
            raise
        finally:
            self._waiting.clear()
        self._written_bytes += written_count

    def _cut_back(self) -> None:
        """Remove the bytes behind the last complete flush."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, self._written_bytes)
            os.lseek(self._handle, self._written_bytes, os.SEEK_SET)

    def close(self) -> None:
        """Close the file; waiting bytes are not written."""
        os.close(self._handle)
