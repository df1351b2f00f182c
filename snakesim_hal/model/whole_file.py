"""Atomic file writes: a file is complete, or absent."""

import contextlib
import os
from pathlib import Path

PARTIAL = ".partial"


def write_whole(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Replace a file atomically. Raises OSError; then the earlier file is unchanged.

    durable: return only when it is on the disk, and survives a loss of power.
    """
    partial = path.with_name(path.name + PARTIAL)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:  # not through a link
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        partial.rename(path)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
    if durable:
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
