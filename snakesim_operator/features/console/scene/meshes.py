"""Meshes of the shapes in the 3-D scene. Pure.

A mesh has vertices (n, 3) in m, and triangles (m, 3) of the indices of their vertices. The vertices of a triangle are
counterclockwise as seen from outside. viser smooths over shared vertices, so both sides of an edge that is to look
sharp have vertices of their own.
"""

import numpy as np
from numpy.typing import NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]

ROUNDING_ERROR_M = 1e-9
ROUND_SIDES = 32  # sides of the polygon that is drawn for a circle


def make_capsule(length_m: float, radius_m: float) -> Mesh:
    """Make a capsule along x about the origin. `length_m` is the distance between the centers of its two spheres."""
    angles_rad = np.linspace(0.0, np.pi / 2, ROUND_SIDES // 4)
    upper_cap = np.column_stack(
        [radius_m * np.sin(angles_rad), length_m / 2 + radius_m * np.cos(angles_rad)]
    )
    lower_cap = upper_cap * [1.0, -1.0]
    profile = np.vstack([lower_cap, upper_cap[::-1]])
    vertices, faces = _revolve_profile(profile)
    along_x = vertices[:, [2, 0, 1]]
    return along_x, faces


def make_sphere(radius_m: float) -> Mesh:
    """Return a sphere about the origin."""
    return make_capsule(0.0, radius_m)


def make_cylinder(radius_m: float, height_m: float) -> Mesh:
    """Return a cylinder along z about the origin."""
    half_m = height_m / 2
    lower_edge = (radius_m, -half_m)
    upper_edge = (radius_m, half_m)
    bottom = _revolve_profile(np.array([(0.0, -half_m), lower_edge]))
    side = _revolve_profile(np.array([lower_edge, upper_edge]))
    top = _revolve_profile(np.array([upper_edge, (0.0, half_m)]))
    return _merge_meshes([bottom, side, top])


def make_tube(radius_m: float, inner_radius_m: float, length_m: float, *, open_top: bool) -> Mesh:
    """Return a hollow pipe along x about the origin. If its top is open, only the half below z = 0 is there."""
    half_m = length_m / 2
    inside = (inner_radius_m, -half_m), (inner_radius_m, half_m)
    outside = (radius_m, -half_m), (radius_m, half_m)
    # Points with decreasing z give a surface that shows its inside.
    profiles = [(inside[1], inside[0]), (inside[0], outside[0]), outside, (outside[1], inside[1])]
    vertices, faces = _merge_meshes([_revolve_profile(np.array(profile)) for profile in profiles])
    vertices = vertices[:, [2, 0, 1]]
    if open_top:
        is_below = vertices[faces][:, :, 2].max(axis=1) <= ROUNDING_ERROR_M
        faces = faces[is_below]
    return vertices, faces


def make_box(half_m: float) -> Mesh:
    """Make a cube about the origin. `half_m` is half the length of an edge."""
    square = np.array([(-1.0, -1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, 1.0), (-1.0, 1.0, 1.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    positive_sides = [np.roll(square, axis, axis=1) * half_m for axis in range(3)]
    negative_sides = [side * [-1.0, -1.0, -1.0] for side in positive_sides]
    # A side that is mirrored at the origin shows its inside, until the order of its vertices is reversed.
    parts = [(side, faces) for side in positive_sides]
    parts += [(side, faces[:, ::-1]) for side in negative_sides]
    return _merge_meshes(parts)


def make_hoops(corners: NDArray[np.float64], half_m: float, width_m: float) -> Mesh:
    """Return two bands about an upright prism, one at its foot and one at its top.

    Args:
        corners: (n, 2) corners of the prism's cross-section, counterclockwise.
        half_m: Half the height of the prism, whose middle is at the origin.
        width_m: Width of a band.
    """
    lower_band = _make_band(corners, -half_m, width_m - half_m)
    upper_band = _make_band(corners, half_m - width_m, half_m)
    return _merge_meshes([lower_band, upper_band])


def _make_band(corners: NDArray[np.float64], low_m: float, high_m: float) -> Mesh:
    count = len(corners)
    low_ring = np.column_stack([corners, np.full(count, low_m)])
    high_ring = np.column_stack([corners, np.full(count, high_m)])
    return np.vstack([low_ring, high_ring]), np.vstack(_make_ring_faces(count))


def make_circle() -> NDArray[np.float64]:
    """Return the corners of the polygon that is drawn for the unit circle, (n, 2), counterclockwise."""
    angles_rad = np.linspace(0.0, 2 * np.pi, ROUND_SIDES, endpoint=False)
    return np.column_stack([np.cos(angles_rad), np.sin(angles_rad)])


def _revolve_profile(profile: NDArray[np.float64]) -> Mesh:
    """Return the surface that a profile sweeps when it is turned about z.

    Args:
        profile: (k, 2) radius and z of each point. Points with increasing z give a surface that shows its outside.
    """
    circle = make_circle()
    rings: list[NDArray[np.float64]] = []
    for radius_m, z_m in profile:
        rings.append(np.column_stack([radius_m * circle, np.full(ROUND_SIDES, z_m)]))
    faces: list[NDArray[np.int64]] = []
    for ring_index in range(len(profile) - 1):
        first_vertex = ring_index * ROUND_SIDES
        faces += [triangles + first_vertex for triangles in _make_ring_faces(ROUND_SIDES)]
    return np.vstack(rings), np.vstack(faces)


def _make_ring_faces(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the triangles between two rings of `count` vertices: two sets of (count, 3).

    The vertices of the lower ring come first, those of the upper ring follow.
    """
    here = np.arange(count)
    after = np.roll(here, -1)
    lower_triangles = np.column_stack([here, after, after + count])
    upper_triangles = np.column_stack([here, after + count, here + count])
    return lower_triangles, upper_triangles


def _merge_meshes(parts: list[Mesh]) -> Mesh:
    """Return several meshes as one."""
    all_vertices: list[NDArray[np.float64]] = []
    all_faces: list[NDArray[np.int64]] = []
    vertex_count = 0
    for vertices, faces in parts:
        all_vertices.append(vertices)
        all_faces.append(faces + vertex_count)
        vertex_count += len(vertices)
    return np.vstack(all_vertices), np.vstack(all_faces)
