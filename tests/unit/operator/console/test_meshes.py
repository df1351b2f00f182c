"""Meshes of the console are closed, have the requested size, and face outwards."""

import math

import numpy as np
import pytest

from snakesim_operator.features.console.scene.meshes import (
    Mesh,
    make_box,
    make_capsule,
    make_cylinder,
    make_sphere,
    make_tube,
)


@pytest.mark.parametrize(
    ("mesh", "half_size_m", "volume_m3"),
    [
        (make_capsule(0.1, 0.03), (0.08, 0.03, 0.03), math.pi * 0.03**2 * (0.1 + 4 / 3 * 0.03)),
        (make_sphere(1.0), (1.0, 1.0, 1.0), 4 / 3 * math.pi),
        (make_cylinder(1.0, 2.0), (1.0, 1.0, 1.0), 2 * math.pi),
        (make_box(1.0), (1.0, 1.0, 1.0), 8.0),
        (make_tube(1.0, 0.5, 4.0, open_top=False), (2.0, 1.0, 1.0), 3 * math.pi),
    ],
)
def test_mesh_has_its_size_and_faces_outwards(
    mesh: Mesh, half_size_m: tuple[float, ...], volume_m3: float
):
    vertices, faces = mesh
    assert vertices.max(axis=0) == pytest.approx(half_size_m)
    assert vertices.min(axis=0) == pytest.approx(np.negative(half_size_m))
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    # The tetrahedra from the origin to each face add up to the volume; a face that points inwards counts as negative.
    mesh_volume_m3 = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert mesh_volume_m3 == pytest.approx(volume_m3, rel=0.03)


def test_mesh_of_open_tube_has_no_top():
    vertices, faces = make_tube(1.0, 0.5, 4.0, open_top=True)
    corners = vertices[faces].reshape(-1, 3)
    assert corners.max(axis=0) == pytest.approx((2.0, 1.0, 0.0))
    assert corners.min(axis=0) == pytest.approx((-2.0, -1.0, -1.0))
