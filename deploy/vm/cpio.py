"""Writes cpio archives (format "newc"), which the Linux kernel unpacks as its first file system."""

FILE, FOLDER = 0o100000, 0o040000
HEADER_FIELDS = 13
END = "TRAILER!!!"


def folder(path: str) -> bytes:
    """An entry for a folder that only root may write."""
    return _entry(path, FOLDER | 0o755, b"")


def file(path: str, content: bytes, permissions: int = 0o644) -> bytes:
    """An entry for a file; the folder that it lies in must come before it."""
    return _entry(path, FILE | permissions, content)


def end() -> bytes:
    """The entry that ends an archive. The kernel takes several archives in a row, the later file winning."""
    return _entry(END, 0, b"")


def _entry(path: str, mode: int, content: bytes) -> bytes:
    name = path.encode() + b"\0"
    inode = uid = gid = mtime = device = checksum = 0
    fields = (
        inode,
        mode,
        uid,
        gid,
        1,
        mtime,
        len(content),
        device,
        device,
        device,
        device,
        len(name),
        checksum,
    )
    assert len(fields) == HEADER_FIELDS
    header = b"070701" + b"".join(b"%08X" % field for field in fields)
    return _aligned(_aligned(header + name) + content)


def _aligned(text: bytes) -> bytes:
    """Fill up to a multiple of four; every part before it is already aligned."""
    return text + b"\0" * (-len(text) % 4)
