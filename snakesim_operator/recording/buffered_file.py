"""A file that grows: its bytes stay in memory until `flush`, and a full disk leaves it as it was at the last flush."""

import contextlib
import errno
import os
from pathlib import Path


class GrowingFile:
    """A new file that buffers in memory what is written. After its creation, only `flush` raises OSError."""

    def __init__(self, path: Path) -> None:
        """Create the file. Raises OSError; FileExistsError if the file exists."""
        self._file_descriptor = os.open(
            path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644
        )
        self._flushed_bytes = 0
        self._buffer = bytearray()

    @property
    def buffered_bytes(self) -> int:
        """Return the number of written bytes that are not on the disk yet."""
        return len(self._buffer)

    def write(self, data: bytes) -> int:
        """Append bytes to the buffer, and return their number."""
        self._buffer += data
        return len(data)

    def tell(self) -> int:
        """Return the position in the file at which the next byte is written."""
        return self._flushed_bytes + len(self._buffer)

    def flush(self) -> None:
        """Write the buffered bytes to the disk: either all of them, or none.

        Raises:
            OSError: The disk does not take all of them. The file then ends where it ended before, and the buffered
                bytes are lost.
        """
        written_bytes = 0
        try:
            while written_bytes < len(self._buffer):
                newly_written_bytes = os.write(self._file_descriptor, self._buffer[written_bytes:])
                if newly_written_bytes == 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                written_bytes += newly_written_bytes
        except OSError:
            self._truncate_to_last_flush()
            raise
        finally:
            self._buffer.clear()
        self._flushed_bytes += written_bytes

    def _truncate_to_last_flush(self) -> None:
        """Remove the bytes that an incomplete flush has written, so that the file ends at the last complete one."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._file_descriptor, self._flushed_bytes)
            os.lseek(self._file_descriptor, self._flushed_bytes, os.SEEK_SET)

    def close(self) -> None:
        """Close the file; waiting bytes are not written."""
        os.close(self._file_descriptor)
