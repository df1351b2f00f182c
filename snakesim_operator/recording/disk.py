"""The bytes of a file that grows: kept in memory until `flush`, and cut back to the last flush when a disk is full."""

import contextlib
import errno
import os
from pathlib import Path


class GrowingFile:
    """What an MCAP writer needs of a file. Raises OSError from `flush` alone."""

    def __init__(self, path: Path) -> None:
        """Raises OSError, FileExistsError when there is such a file."""
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._written = 0
        self._waiting = bytearray()

    @property
    def waiting_bytes(self) -> int:
        """Not yet given to the disk."""
        return len(self._waiting)

    def write(self, data: bytes) -> int:
        """Add bytes."""
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        """Where the next byte goes."""
        return self._written + len(self._waiting)

    def flush(self) -> None:
        """Give everything to the disk. Raises OSError; then the file ends where it ended before."""
        done = 0
        try:
            while done < len(self._waiting):
                count = os.write(self._handle, self._waiting[done:])
                if not count:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                done += count
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._handle, self._written)
                os.lseek(self._handle, self._written, os.SEEK_SET)
            raise
        finally:
            self._waiting.clear()
        self._written += done

    def close(self) -> None:
        """Close it."""
        os.close(self._handle)
