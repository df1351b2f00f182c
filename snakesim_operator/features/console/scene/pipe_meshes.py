"""Draws the pipes of a scene. A hollow pipe is transparent, so that the snake in it is visible."""

from collections.abc import Sequence

import viser

from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.model.scene_file.pipes import get_pipe_name
from snakesim_hal.model.scene_file.terrain import Pipe
from snakesim_operator.features.console.scene import scene_colors
from snakesim_operator.features.console.scene.meshes import Mesh, make_capsule, make_tube

HOLLOW_OPACITY = 0.35


def add_pipes(scene: viser.SceneApi, pipes: Sequence[Pipe]) -> None:
    """Add the pipes to the scene of all viewers."""
    for index, pipe in enumerate(pipes):
        vertices, faces = _make_pipe(pipe)
        opacity = None if pipe.inner_radius_m is None else HOLLOW_OPACITY
        scene.add_mesh_simple(
            f"/world/pipes/{get_pipe_name(index, pipe)}",
            vertices,
            faces,
            color=scene_colors.HILLS,
            opacity=opacity,
            side="double",
            cast_shadow=False,
            position=(*pipe.position_m, pipe.find_axis_height_m()),
            wxyz=quaternion_from_yaw(pipe.yaw_rad),
        )


def _make_pipe(pipe: Pipe) -> Mesh:
    """Return the mesh of a pipe along x about the origin."""
    if pipe.inner_radius_m is None:
        return make_capsule(pipe.length_m - 2 * pipe.radius_m, pipe.radius_m)
    return make_tube(pipe.radius_m, pipe.inner_radius_m, pipe.length_m, open_top=pipe.open_top)
