"""Vertices of mesh files, to find the extent of a link: STL, both kinds, and OBJ."""

import struct
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError

MAX_BYTES = 64 * 1024 * 1024
STL_HEADER, STL_TRIANGLE = 84, 50


def find_mesh(name: str, urdf: Path) -> Path | None:
    """The file that a URDF means; None when it is not on this computer.

    `package://NAME/...` is looked for in the folders above the URDF, in one called NAME or directly.
    """
    if name.startswith("package://"):
        package, _, inside = name.removeprefix("package://").partition("/")
        folders = [urdf.absolute().parent, *urdf.absolute().parents]
        tried = [path for folder in folders for path in (folder / package / inside, folder / inside)]
    else:
        tried = [urdf.parent / name.removeprefix("file://")]
    try:
        return next((path for path in tried if path.is_file()), None)
    except (OSError, ValueError):  # a name too long, or with a NUL
        return None


def vertices(path: Path) -> Floats:
    """Corners of all faces, (n, 3), in the file's unit. Raises ConfigError for another format or a damaged file."""
    if path.suffix.lower() not in (".stl", ".obj"):
        raise ConfigError(f"{path}: only STL and OBJ can be read")
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path}: is larger than {MAX_BYTES // 1024 // 1024} MB")
    found = _binary_stl(data) if path.suffix.lower() == ".stl" else None
    if found is None:
        found = _lines_of(data, path)
    if not len(found) or not np.isfinite(found).all():
        raise ConfigError(f"{path}: holds no vertices, or numbers that are not finite")
    return found


def _binary_stl(data: bytes) -> Floats | None:
    if len(data) < STL_HEADER:
        return None
    (count,) = struct.unpack_from("<I", data, STL_HEADER - 4)
    if len(data) != STL_HEADER + count * STL_TRIANGLE:
        return None
    rows = np.frombuffer(data, dtype=[("normal", "<f4", 3), ("at", "<f4", (3, 3)), ("rest", "<u2")], offset=STL_HEADER)
    return rows["at"].reshape(-1, 3).astype(np.float64)


def _lines_of(data: bytes, path: Path) -> Floats:
    """Lines `vertex x y z` of an STL in text, or `v x y z` of an OBJ."""
    rows = [
        line.split()[1:4] for line in data.splitlines() if line.lstrip()[:7].lower().startswith((b"vertex ", b"v "))
    ]
    try:
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    except ValueError:
        raise ConfigError(f"{path}: a vertex is not three numbers") from None
