"""The obstacles of a scene at their places: peg rows and random fields are expanded into plain obstacles.

`validate_start_clearance` rejects a scene in which an obstacle overlaps the snake at its start pose.
"""

import math
from collections import Counter

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.outlines import CapsuleOutline, ObstacleOutlines
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.model.scene_file.pipes import get_pipe_name, make_pipe_block, validate_pipes
from snakesim_hal.model.scene_file.platforms import Platform, count_platforms, make_platforms
from snakesim_hal.model.scene_file.random_field import (
    MAX_RANDOM_OBSTACLES,
    RandomField,
    place_random_obstacles,
    sample_materials_and_leans,
)
from snakesim_hal.model.scene_file.scene import (
    Box,
    Cylinder,
    PegsAlongRoute,
    SceneFile,
    Sphere,
    Wall,
    make_route,
)
from snakesim_hal.model.scene_file.solids import (
    SolidObstacle,
    UprightSolid,
    get_material_fields,
    make_block,
    make_peg,
)
from snakesim_hal.wire.messages import KnownObstacle

SAMPLES_PER_LINK = 24  # points along a link's axis at which the distance to obstacles is computed
OVERLAP_TOLERANCE_M = 1e-4  # a smaller overlap of an obstacle and a link is a rounding error
MAX_OBSTACLES = 4096  # bound of the message World


class PlacedObstacle(UprightSolid, frozen=True, kw_only=True):
    """A placed obstacle, with parameters that only the simulator needs."""

    obstacle: KnownObstacle
    # A step or platform: part of the ground, so the snake does not push off from it.
    walkable: bool = False


def place_scene_obstacles(
    scene: SceneFile, keep_clear: list[CapsuleOutline] | None = None
) -> list[PlacedObstacle]:
    """Place all obstacles of a scene. Peg rows and random fields are expanded into single obstacles with unique names.

    Args:
        scene: Scene file.
        keep_clear: Outlines of the snake's links at its start, from which random obstacles keep a distance. None if
            they need not.

    Raises:
        ConfigError: There are too many obstacles, one cannot be placed, or two have the same name.
    """
    _validate_obstacle_count(scene)
    placed: list[PlacedObstacle] = [
        *(_place_cylinder(i, cylinder) for i, cylinder in enumerate(scene.cylinder)),
        *(_place_box(i, box) for i, box in enumerate(scene.box)),
        *(_place_sphere(i, sphere) for i, sphere in enumerate(scene.sphere)),
        *(_place_wall(scene, i, wall) for i, wall in enumerate(scene.wall)),
        *(_place_platform(platform) for platform in make_platforms(scene)),
    ]
    route = make_route(scene)
    for i, row in enumerate(scene.pegs_along_route):
        placed += _place_pegs_along_route(scene, i, row, route)
    for i, field in enumerate(scene.random_field):
        placed += _place_random_field(scene, i, field, route, placed, keep_clear or [])
    _validate_unique_names(scene, placed)
    return placed


def outline_pipes(scene: SceneFile) -> list[PlacedObstacle]:
    """Return the pipes of a scene as blocks with their outlines from above, for drawings."""
    return [
        PlacedObstacle(obstacle=make_pipe_block(i, pipe), walkable=True)
        for i, pipe in enumerate(scene.pipe)
    ]


def _validate_obstacle_count(scene: SceneFile) -> None:
    """Raise ConfigError if the scene has more obstacles than a message can hold."""
    single_obstacles = (scene.cylinder, scene.box, scene.sphere, scene.wall)
    count = sum(len(obstacles) for obstacles in single_obstacles)
    count += count_platforms(scene)
    count += sum(row.count for row in scene.pegs_along_route)
    count += sum(min(field.target_count, MAX_RANDOM_OBSTACLES) for field in scene.random_field)
    if count > MAX_OBSTACLES:
        raise ConfigError(
            f"scene {scene.name!r}: has {count} obstacles; at most {MAX_OBSTACLES} are allowed",
            code="scene/invalid",
        )


def _validate_unique_names(scene: SceneFile, placed: list[PlacedObstacle]) -> None:
    """Raise ConfigError if two obstacles or pipes have the same name."""
    counts = Counter(item.obstacle.name for item in placed)
    counts.update(get_pipe_name(i, pipe) for i, pipe in enumerate(scene.pipe))
    duplicates = sorted(name for name, count in counts.items() if count > 1)
    if duplicates:
        raise ConfigError(
            f"scene {scene.name!r}: two obstacles are called {duplicates[0]!r}; rename one",
            code="config/duplicate-name",
        )


def _add_material(obstacle: KnownObstacle, solid: SolidObstacle) -> PlacedObstacle:
    """Return a placed obstacle with the material and the lean that its section in the scene file gives."""
    return PlacedObstacle(obstacle=obstacle, **get_material_fields(solid))


def _place_cylinder(index: int, cylinder: Cylinder) -> PlacedObstacle:
    name = cylinder.name or f"cylinder_{index}"
    obstacle = make_peg(name, cylinder.position_m, cylinder.radius_m, cylinder.height_m)
    return _add_material(obstacle, cylinder)


def _place_box(index: int, box: Box) -> PlacedObstacle:
    name = box.name or f"box_{index}"
    obstacle = make_block(name, box.position_m, box.size_m, box.yaw_rad)
    return _add_material(obstacle, box)


def _place_sphere(index: int, sphere: Sphere) -> PlacedObstacle:
    obstacle = KnownObstacle(
        name=sphere.name or f"sphere_{index}",
        shape="sphere",
        position_w=(*sphere.position_m, sphere.center_height_m),
        radius_m=sphere.radius_m,
        height_m=2 * sphere.radius_m,
    )
    return _add_material(obstacle, sphere)


def _place_wall(scene: SceneFile, index: int, wall: Wall) -> PlacedObstacle:
    """Return a wall as a block whose length is along the wall."""
    from_x, from_y = wall.from_m
    to_x, to_y = wall.to_m
    run_x = to_x - from_x
    run_y = to_y - from_y
    length_m = math.hypot(run_x, run_y)
    if length_m == 0:
        raise ConfigError(
            f"scene {scene.name!r}: `wall.{index}`: `from_m` and `to_m` are the same point",
            code="scene/invalid",
        )
    name = wall.name or f"wall_{index}"
    middle_m = ((from_x + to_x) / 2, (from_y + to_y) / 2)
    size_m = (length_m, wall.thickness_m, wall.height_m)
    obstacle = make_block(name, middle_m, size_m, math.atan2(run_y, run_x))
    return _add_material(obstacle, wall)


def _place_platform(platform: Platform) -> PlacedObstacle:
    surface = platform.surface
    return PlacedObstacle(
        obstacle=platform.block,
        friction=surface.friction,
        forward_friction=surface.forward_friction,
        backward_friction=surface.backward_friction,
        walkable=True,
    )


def _place_pegs_along_route(
    scene: SceneFile, index: int, row: PegsAlongRoute, route: Route | None
) -> list[PlacedObstacle]:
    """Place the pegs of one `[[pegs_along_route]]`: one at each inflection, on the side from which it pushes forward.

    Args:
        scene: Scene file, whose name is in errors.
        index: Index of this row of pegs in the scene file.
        row: Section of the row.
        route: Route of the scene, or None if it has none.

    Raises:
        ConfigError: The scene has no route, or the route has too few inflections.
    """
    context = f"scene {scene.name!r}: `pegs_along_route.{index}`"
    if route is None:
        raise ConfigError(
            f"{context}: the scene has no route; add a [route] section", code="scene/no-route"
        )
    inflections_s_m = route.find_inflections_s_m()
    used_s_m = inflections_s_m[row.first : row.first + row.count]
    if len(used_s_m) < row.count:
        available_count = len(inflections_s_m)
        raise ConfigError(
            f"{context}: `count` = {row.count} pegs from inflection {row.first} on, but the route has "
            f"{available_count} inflections; make the route longer or `count` at most "
            f"{max(available_count - row.first, 0)}",
            code="scene/invalid",
        )
    start_w, end_w = route.compute_positions_w(np.array([0.0, route.length_m]))
    forward_w = (end_w - start_w) / np.linalg.norm(end_w - start_w)
    pegs: list[PlacedObstacle] = []
    for inflection, s_m in enumerate(used_s_m, start=row.first):
        tangent = route.tangent_w(s_m)
        left_w = np.array([-tangent[1], tangent[0]])
        is_forward = left_w @ forward_w > 0
        # Direction of the force from the peg on the body: to the side of the route that is forward.
        push_direction_w = left_w if is_forward else -left_w
        distance_m = row.corridor_m + row.radius_m  # from the route to the center of the peg
        center_w = route.compute_positions_w(s_m) - push_direction_w * distance_m
        center_m = (float(center_w[0]), float(center_w[1]))
        obstacle = make_peg(f"peg_{index}_{inflection}", center_m, row.radius_m, row.height_m)
        pegs.append(_add_material(obstacle, row))
    return pegs


def _place_random_field(
    scene: SceneFile,
    index: int,
    field: RandomField,
    route: Route | None,
    placed: list[PlacedObstacle],
    keep_clear: list[CapsuleOutline],
) -> list[PlacedObstacle]:
    """Place the obstacles of one random field, with a gap to those that are placed already."""
    context = f"scene {scene.name!r}: `random_field.{index}`"
    existing_obstacles = [item.obstacle for item in placed if not item.walkable]
    obstacles = place_random_obstacles(field, context, index, route, existing_obstacles, keep_clear)
    solids = sample_materials_and_leans(field, index, len(obstacles))
    return [
        _add_material(obstacle, solid) for obstacle, solid in zip(obstacles, solids, strict=True)
    ]


def validate_start_clearance(
    scene: SceneFile, placed: list[PlacedObstacle], snake: list[CapsuleOutline]
) -> None:
    """Check that no obstacle overlaps the snake at its start, and that the snake fits into the pipes there.

    Args:
        scene: Scene file, whose name is in the error.
        placed: All obstacles of the scene. The snake may lie on walkable ones.
        snake: Outlines of the snake's links.

    Raises:
        ConfigError: An obstacle or the wall of a pipe overlaps a link. The error is about the first such obstacle in
            the order of the scene, and names it, the link, and how far they overlap.
    """
    validate_pipes(scene, snake)
    height_m = max(link.radius_m for link in snake)
    obstacles = [_move_to_height(item, height_m) for item in placed if not item.walkable]
    overlaps_m = _compute_overlaps_m(snake, obstacles)  # (links, obstacles)
    is_overlapping = overlaps_m > OVERLAP_TOLERANCE_M
    if not is_overlapping.any():
        return
    overlapping_obstacles = np.flatnonzero(is_overlapping.any(axis=0))
    obstacle_index = overlapping_obstacles[0]
    overlapping_links = np.flatnonzero(is_overlapping[:, obstacle_index])
    link_index = overlapping_links[0]
    overlap_mm = overlaps_m[link_index, obstacle_index] * 1000
    raise ConfigError(
        f"scene {scene.name!r}: obstacle {obstacles[obstacle_index].name!r} overlaps {snake[link_index].name} of "
        f"the snake at its start by {overlap_mm:.1f} mm; move the obstacle, give the pegs more `corridor_m`, or "
        f"change [start] in the scenario",
        code="scene/overlap",
    )


def _compute_overlaps_m(snake: list[CapsuleOutline], obstacles: list[KnownObstacle]) -> Floats:
    """Return how far every link and obstacle overlap, (links, obstacles); negative where there is a gap.

    The distance of a link's axis from an obstacle's center is exact, which suffices for round obstacles. For boxes the
    distances from `SAMPLES_PER_LINK` points along the axis are taken, too, and the smallest one counts.
    """
    outlines = ObstacleOutlines.from_obstacles(obstacles)
    rear_w = np.array([link.rear_m for link in snake])  # (links, 2)
    front_w = np.array([link.front_m for link in snake])
    radius_m = np.array([link.radius_m for link in snake])

    # Distance of each obstacle from points along the axis of each link, which are (links, SAMPLES_PER_LINK, 2).
    fractions = np.linspace(0.0, 1.0, SAMPLES_PER_LINK)[:, None]
    points_w = rear_w[:, None] + fractions * (front_w - rear_w)[:, None]
    from_points_m = outlines.compute_distances_m(points_w).min(axis=1)  # (links, obstacles)

    # Distance of each obstacle's center from the whole axis of each link, without the obstacle's rounding.
    axes = ObstacleOutlines.from_segments(rear_w, front_w)
    center_distances_m = axes.compute_distances_m(outlines.center_w).T  # (links, obstacles)
    from_axes_m = center_distances_m - outlines.rounding_m

    distances_m = np.minimum(from_points_m, from_axes_m)  # of the axes, which are without thickness
    return radius_m[:, None] - distances_m


def _move_to_height(item: PlacedObstacle, height_m: float) -> KnownObstacle:
    """Return an obstacle moved to where its axis, which may lean, is at a height above the ground."""
    x, y, z = item.obstacle.position_w
    offset_m = height_m * math.tan(item.lean_rad)
    lean_x = x + offset_m * math.cos(item.lean_towards_rad)
    lean_y = y + offset_m * math.sin(item.lean_towards_rad)
    return msgspec.structs.replace(item.obstacle, position_w=(lean_x, lean_y, z))
