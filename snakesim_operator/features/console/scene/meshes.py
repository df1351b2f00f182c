"""Meshes of the shapes that are drawn: vertices (n, 3) in metres, and triangles (m, 3) of their numbers. Pure.

viser smooths over shared vertices, so edges that are to look sharp have vertices of their own.
"""

import numpy as np
from numpy.typing import NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]

ROUND = 32  # sides of what is round


def capsule(length_m: float, radius_m: float) -> Mesh:
    """Along x, from sphere's center to sphere's center `length_m`, about the origin."""
    angle = np.linspace(0.0, np.pi / 2, ROUND // 4)
    cap = np.column_stack([radius_m * np.sin(angle), length_m / 2 + radius_m * np.cos(angle)])
    vertices, faces = _turned(np.vstack([cap * [1.0, -1.0], cap[::-1]]))
    return vertices[:, [2, 0, 1]], faces


def sphere(radius_m: float) -> Mesh:
    """About the origin."""
    return capsule(0.0, radius_m)


def cylinder(radius_m: float, height_m: float) -> Mesh:
    """Along z, about the origin."""
    half_m = height_m / 2
    side = [(radius_m, -half_m), (radius_m, half_m)]
    parts = [_turned(np.array(part)) for part in ([(0.0, -half_m), side[0]], side, [side[1], (0.0, half_m)])]
    return _merged(parts)


def box(half_m: float) -> Mesh:
    """A cube about the origin."""
    square = np.array([(-1.0, -1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, 1.0), (-1.0, 1.0, 1.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    sides = [np.roll(square, k, axis=1) * half_m for k in range(3)]
    turned = [side * [-1.0, -1.0, -1.0] for side in sides]
    return _merged([*[(side, faces) for side in sides], *[(side, faces[:, ::-1]) for side in turned]])


def hoops(corners: NDArray[np.float64], half_m: float, width_m: float) -> Mesh:
    """Bands about an upright prism of corners (n, 2): at its foot, from -half_m, and at its top."""
    here, count = np.arange(len(corners)), len(corners)
    after = np.roll(here, -1)
    faces = np.vstack(
        [np.column_stack([here, after, after + count]), np.column_stack([here, after + count, here + count])]
    )
    bands = [(-half_m, width_m - half_m), (half_m - width_m, half_m)]
    return _merged(
        [(np.vstack([np.column_stack([corners, np.full(count, z)]) for z in band]), faces) for band in bands]
    )


def circle() -> NDArray[np.float64]:
    """Corners of the unit circle, (n, 2)."""
    angle = np.linspace(0.0, 2 * np.pi, ROUND, endpoint=False)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _turned(profile: NDArray[np.float64]) -> Mesh:
    """A profile of (radius, z), turned about z. From low z to high z outside is outside."""
    around = circle()
    rings = [np.column_stack([radius * around, np.full(ROUND, z)]) for radius, z in profile]
    here = np.arange(ROUND)
    after = np.roll(here, -1)
    faces = [
        triangle + i * ROUND
        for i in range(len(profile) - 1)
        for triangle in (
            np.column_stack([here, after, after + ROUND]),
            np.column_stack([here, after + ROUND, here + ROUND]),
        )
    ]
    return np.vstack(rings), np.vstack(faces)


def _merged(parts: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *[len(vertices) for vertices, _ in parts[:-1]]])
    faces = np.vstack([faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)])
    return np.vstack([vertices for vertices, _ in parts]), faces
