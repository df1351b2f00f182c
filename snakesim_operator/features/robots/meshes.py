"""Reads the vertices of mesh files, from which the extent of a link follows: binary and text STL, and OBJ."""

import struct
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError

MAX_FILE_BYTES = 64 * 1024 * 1024
STL_HEADER_BYTES = 84
STL_TRIANGLE_BYTES = 50
STL_TRIANGLE_DTYPE = np.dtype(
    [("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attributes", "<u2")]
)


def find_mesh_file(name: str, urdf: Path) -> Path | None:
    """Return the path of the mesh that a URDF names, or None if it is not on this computer.

    `package://NAME/...` is looked for in the folders above the URDF, in one called NAME or directly.
    """
    if name.startswith("package://"):
        package, _, inside = name.removeprefix("package://").partition("/")
        folders = [urdf.absolute().parent, *urdf.absolute().parents]
        candidates: list[Path] = []
        for folder in folders:
            candidates += [folder / package / inside, folder / inside]
    else:
        candidates = [urdf.parent / name.removeprefix("file://")]
    try:
        return next((path for path in candidates if path.is_file()), None)
    except (OSError, ValueError):  # a name too long, or with a NUL
        return None


def read_mesh_vertices(path: Path) -> Floats:
    """Read the corners of all faces of an STL or OBJ file, (n, 3), in the file's unit of length.

    Raises:
        ConfigError: The file has another format, is damaged, or is too large.
    """
    if path.suffix.lower() not in (".stl", ".obj"):
        raise ConfigError(f"{path}: only STL and OBJ can be read", code="urdf/invalid")
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}", code="urdf/invalid"
        ) from None
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(
            f"{path}: is larger than {MAX_FILE_BYTES // 1024 // 1024} MB", code="urdf/invalid"
        )
    points = _parse_binary_stl(data) if path.suffix.lower() == ".stl" else None
    if points is None:
        points = _parse_text(data, path)
    if not len(points) or not np.isfinite(points).all():
        raise ConfigError(
            f"{path}: holds no vertices, or numbers that are not finite", code="urdf/invalid"
        )
    return points


def _parse_binary_stl(data: bytes) -> Floats | None:
    """Return the vertices of a binary STL, or None if the data is something else."""
    if len(data) < STL_HEADER_BYTES:
        return None
    (count,) = struct.unpack_from("<I", data, STL_HEADER_BYTES - 4)
    if len(data) != STL_HEADER_BYTES + count * STL_TRIANGLE_BYTES:
        return None
    triangles = np.frombuffer(data, dtype=STL_TRIANGLE_DTYPE, offset=STL_HEADER_BYTES)
    return triangles["vertices"].reshape(-1, 3).astype(np.float64)


def _parse_text(data: bytes, path: Path) -> Floats:
    """Return the vertices of a text STL, lines `vertex x y z`, or of an OBJ, lines `v x y z`. Raises ConfigError."""
    rows: list[list[bytes]] = []
    for line in data.splitlines():
        if line.lstrip()[:7].lower().startswith((b"vertex ", b"v ")):
            rows.append(line.split()[1:4])
    try:
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    except ValueError:
        raise ConfigError(f"{path}: a vertex is not three numbers", code="urdf/invalid") from None
