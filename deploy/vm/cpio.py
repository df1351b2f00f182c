"""Writes cpio archives (format "newc"), which the Linux kernel unpacks as its first file system."""

FILE_TYPE = 0o100000  # bits of the mode that mark a file
FOLDER_TYPE = 0o040000
HEADER_FIELDS = 13
END_NAME = "TRAILER!!!"


def make_folder_entry(path: str) -> bytes:
    """Return the entry of a folder that only root may write."""
    return _make_entry(path, FOLDER_TYPE | 0o755, b"")


def make_file_entry(path: str, content: bytes, permissions: int = 0o644) -> bytes:
    """Return the entry of a file. The entry of its folder must come before it."""
    return _make_entry(path, FILE_TYPE | permissions, content)


def make_end_entry() -> bytes:
    """Return the entry that ends an archive.

    The kernel unpacks several archives in a row. A file of a later archive replaces one of an earlier archive.
    """
    return _make_entry(END_NAME, 0, b"")


def _make_entry(path: str, mode: int, content: bytes) -> bytes:
    name = path.encode() + b"\0"
    fields = (
        0,  # inode
        mode,
        0,  # user
        0,  # group
        1,  # links
        0,  # modification time
        len(content),
        0,  # device, major
        0,  # device, minor
        0,  # device that a special file stands for, major
        0,  # device that a special file stands for, minor
        len(name),
        0,  # checksum
    )
    assert len(fields) == HEADER_FIELDS
    header = b"070701" + b"".join(b"%08X" % field for field in fields)
    return _pad(_pad(header + name) + content)


def _pad(content: bytes) -> bytes:
    """Pad bytes with zeros to a multiple of four bytes."""
    return content + b"\0" * (-len(content) % 4)
