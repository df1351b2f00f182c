"""Obstacles in the 3-D scene: one batch of equal meshes for each shape, stretched to each obstacle's size."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.features.console.scene.batches import add_batch, to_float32
from snakesim_operator.features.console.scene.drawing import SnapshotDrawing
from snakesim_operator.features.console.scene.meshes import (
    Mesh,
    make_box,
    make_circle,
    make_cylinder,
    make_hoops,
    make_sphere,
)
from snakesim_operator.features.console.scene.scene_colors import (
    OBSTACLE,
    OBSTACLE_AHEAD,
    PERCEIVED,
    PUSHED_OBSTACLE,
    Color,
    convert_to_linear_colors,
)

SQUARE = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
TRUE_SHAPES: dict[str, Mesh] = {
    "cylinder": make_cylinder(1.0, 1.0),
    "box": make_box(1.0),
    "sphere": make_sphere(1.0),
}
# Perceived obstacles are hoops about the believed place, so that the true obstacle stays visible within them.
PERCEIVED_SHAPES: dict[str, Mesh] = {
    "cylinder": make_hoops(make_circle(), 0.5, 0.13),
    "box": make_hoops(SQUARE, 1.0, 0.26),
    "sphere": make_hoops(make_circle(), 0.13, 0.26),
}
TRUE_OPACITY = 0.5  # no obstacle may hide the snake or a force
PERCEIVED_SCALE = 1.05  # hoops are a little larger than the obstacle within them
MIN_HEIGHT_M = 0.01  # of a cylinder whose perceived height is unknown: it is drawn flat


class ObstacleMeshes:
    """Draws the obstacles of one kind: the true ones, or those that guidance perceives."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        shapes: dict[str, Mesh],
        color: Color,
        **options: Any,
    ) -> None:
        """Prepare to draw; nothing is added to the scene yet.

        Args:
            scene: The scene of all viewers.
            name: Folder of the nodes below /world.
            shapes: Unit mesh for each shape of an obstacle.
            color: Color of every obstacle until `set_colors`.
            options: More arguments for viser's batches.
        """
        self._scene = scene
        self._name = name
        self._shapes = shapes
        self._color = color
        self._options = options
        self.batches: dict[str, viser.BatchedMeshHandle] = {}  # by shape

    def draw_obstacles(self, obstacles: Sequence[KnownObstacle], scale: float = 1.0) -> None:
        """Draw these obstacles, and hide shapes of which there is none."""
        for shape in self._shapes:
            self._show_shape(
                shape, [obstacle for obstacle in obstacles if obstacle.shape == shape], scale
            )

    def _show_shape(self, shape: str, obstacles: Sequence[KnownObstacle], scale: float) -> None:
        batch = self.batches.get(shape)
        if batch is not None:
            batch.visible = bool(obstacles)
        if not obstacles:
            return
        count = len(obstacles)
        if batch is None:
            name = f"{self._name}/{shape}"
            batch = add_batch(
                self._scene, name, self._shapes[shape], count, self._color, **self._options
            )
            self.batches[shape] = batch
        sizes = np.array([_compute_mesh_scale(obstacle) for obstacle in obstacles])
        batch.batched_positions = to_float32([obstacle.position_w for obstacle in obstacles])
        batch.batched_wxyzs = to_float32(
            [quaternion_from_yaw(obstacle.yaw_rad) for obstacle in obstacles]
        )
        batch.batched_scales = to_float32(scale * sizes)
        if len(batch.batched_colors) != count:
            batch.batched_colors = convert_to_linear_colors([self._color] * count)

    def set_colors(self, shape: str, colors: Sequence[Color]) -> None:
        """Color the obstacles of a shape, one color each."""
        batch = self.batches.get(shape)
        if batch is not None:
            batch.batched_colors = convert_to_linear_colors(colors)

    def set_opacities(self, shape: str, opacities: Sequence[float]) -> None:
        """Make the obstacles of a shape more or less transparent, 0 to 1 each."""
        batch = self.batches.get(shape)
        if batch is not None:
            batch.batched_opacities = to_float32(opacities)


class TrueObstacles:
    """Draws the obstacles that are really there, colored by what the body does with them."""

    def __init__(self, scene: viser.SceneApi, obstacles: Sequence[KnownObstacle]) -> None:
        self._obstacles = obstacles
        self._meshes = ObstacleMeshes(scene, "true", TRUE_SHAPES, OBSTACLE, opacity=TRUE_OPACITY)
        self._meshes.draw_obstacles(obstacles)

    def update_nodes(self, drawing: SnapshotDrawing) -> None:
        """Mark the obstacles that the body pushes off, and those that navigation expects it to push off."""
        for shape in TRUE_SHAPES:
            names = [obstacle.name for obstacle in self._obstacles if obstacle.shape == shape]
            if names:
                self._meshes.set_colors(
                    shape, [_choose_obstacle_color(name, drawing) for name in names]
                )


class PerceivedObstacles:
    """Draws the obstacles that guidance perceives, the more opaque the more certain it is."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.meshes = ObstacleMeshes(
            scene,
            "perceived",
            PERCEIVED_SHAPES,
            PERCEIVED,
            opacity=1.0,
            side="double",
            cast_shadow=False,
        )

    def draw_obstacles(self, obstacles: Sequence[KnownObstacle]) -> None:
        """Draw these obstacles, and hide those of the frame before."""
        self.meshes.draw_obstacles(obstacles, PERCEIVED_SCALE)
        for shape in PERCEIVED_SHAPES:
            opacities = [
                0.4 + 0.6 * obstacle.confidence for obstacle in obstacles if obstacle.shape == shape
            ]
            if opacities:
                self.meshes.set_opacities(shape, opacities)


def _choose_obstacle_color(name: str, drawing: SnapshotDrawing) -> Color:
    if name in drawing.pushed_obstacles:
        return PUSHED_OBSTACLE
    if name in drawing.obstacles_ahead:
        return OBSTACLE_AHEAD
    return OBSTACLE


def _compute_mesh_scale(obstacle: KnownObstacle) -> tuple[float, float, float]:
    """Return the factors by which the unit mesh of the obstacle's shape is stretched along x, y and z."""
    match obstacle.shape:
        case "box":
            return obstacle.half_size_m
        case "cylinder":
            return obstacle.radius_m, obstacle.radius_m, max(obstacle.height_m, MIN_HEIGHT_M)
        case _:
            return obstacle.radius_m, obstacle.radius_m, obstacle.radius_m
