"""Atomic file writes: a file is complete, or absent."""

import contextlib
import os
import shutil
from collections.abc import Iterator
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


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield another path, for a library to write a file or a folder there; then it takes the place of `path`.

    The other path has the same suffix, by which libraries choose a format. If anything is raised, `path` is unchanged
    and nothing is left of the other one.
    """
    partial = path.with_name(f"{path.stem}{PARTIAL}{path.suffix}")
    _remove(partial)  # of a process that was killed
    try:
        yield partial
        partial.rename(path)
    except BaseException:
        with contextlib.suppress(OSError):
            _remove(partial)
        raise


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
