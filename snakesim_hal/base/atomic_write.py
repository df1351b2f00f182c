"""Atomic file writes: a file is complete, or absent."""

import contextlib
import errno
import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

PARTIAL_SUFFIX = ".partial"  # suffix of a file that is not complete yet


def write_atomically(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write a whole file so that it has either the old or the new content at any time. Its permissions are kept.

    A symbolic link at `path` is replaced, not followed: this is for files of this program, whose folder another user
    may write to. For a file that belongs to the user there is `write_through`.

    Args:
        path: Path of the file. Its folder must exist.
        content: New content of the file.
        durable: If True, return only when the content is on the disk, so that it survives a loss of power.

    Raises:
        OSError: The file cannot be written. The earlier file is unchanged.
    """
    partial = path.with_name(path.name + PARTIAL_SUFFIX)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:  # exclusive: it does not write through a link
            permissions = _read_permissions(path)
            if permissions is not None:
                os.fchmod(file.fileno(), permissions)
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


def write_through(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Replace a file of the user atomically; where `path` is a symbolic link, the file that it leads to.

    The link stays, and the file keeps its permissions. Raises OSError; then the earlier file is unchanged.
    """
    target = path
    if path.is_symlink():
        # A link to nowhere is a mistake of the user, not a wish for a new file.
        target = path.resolve(strict=True)
        if not target.is_file():
            raise OSError(errno.EINVAL, "its symbolic link does not lead to a file", str(path))
    write_atomically(target, content, durable=durable)


def _read_permissions(path: Path) -> int | None:
    """Return the permissions of a regular file; None without one."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return None
    return stat.S_IMODE(mode) if stat.S_ISREG(mode) else None


@contextlib.contextmanager
def replace_atomically(path: Path) -> Iterator[Path]:
    """Yield another path, for a library to write a file or a folder there; then it takes the place of `path`.

    The other path has the same suffix, by which libraries choose a format. If anything is raised, `path` is unchanged
    and nothing is left of the other one.
    """
    partial = path.with_name(f"{path.stem}{PARTIAL_SUFFIX}{path.suffix}")
    _remove_if_exists(partial)  # a process that was killed may have left it
    try:
        yield partial
        partial.rename(path)
    except BaseException:
        with contextlib.suppress(OSError):
            _remove_if_exists(partial)
        raise


def _remove_if_exists(path: Path) -> None:
    """Remove a file, or a folder with its contents."""
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
