"""Batches of viser: many instances of one mesh as one node of the scene."""

from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from snakesim_operator.features.console.scene.meshes import Mesh
from snakesim_operator.features.console.scene.scene_colors import Color, convert_to_linear_colors


def to_float32(values: ArrayLike) -> NDArray[np.float32]:
    """Return values in the type in which viser sends them."""
    return np.asarray(values, dtype=np.float32)


def add_batch(
    scene: viser.SceneApi, name: str, mesh: Mesh, count: int, color: Color, **options: Any
) -> viser.BatchedMeshHandle:
    """Add `count` instances of a mesh at the origin, in one color, as node `name` below /world."""
    vertices, faces = mesh
    return scene.add_batched_meshes_simple(
        f"/world/{name}",
        vertices,
        faces,
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        batched_positions=np.zeros((count, 3)),
        batched_scales=np.ones((count, 3)),
        batched_colors=convert_to_linear_colors([color] * count),
        lod="off",
        **options,
    )
