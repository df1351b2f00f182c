"""The scene file: ground, obstacles, and the route of the snake through them.

The simulator builds the scene, guidance uses it as its map, and the report draws it. `place` expands peg rows and
random fields into plain obstacles. `check_clear` rejects a scene in which an obstacle overlaps the snake's start pose.
"""

import math
from collections import Counter
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.outlines import Capsule, Coordinate, Friction, Heading, Outlines, Point, Size
from snakesim_hal.model.random_field import MAX_RANDOM_OBSTACLES, RandomField, make_solids, place_random_obstacles
from snakesim_hal.model.route import Route, sine_points
from snakesim_hal.model.solids import Solid, Upright, make_block, make_peg, material_fields
from snakesim_hal.wire.messages import Obstacle
from snakesim_hal.wire.quantities import Name, above


class Heightfield(FileStruct, frozen=True, kw_only=True):
    """Smooth random hills."""

    height_m: Annotated[float, above(1, "m")]
    """Height from the lowest to the highest point of the ground."""

    wavelength_m: Annotated[float, above(100, "m")]
    """Typical distance between two hills."""

    area_m: Annotated[float, above(200, "m")] = 20.0
    """Edge length of the square around the origin that has hills."""

    seed: Annotated[int, Meta(ge=0, le=2**31)] = 0
    """Seed of the random hills; the same seed gives the same hills."""


class Ground(FileStruct, frozen=True, kw_only=True):
    """The ground, and its friction."""

    friction: Friction
    """Coulomb friction between the ground and the snake."""

    heightfield: Heightfield | None = None
    """Random hills; none: the ground is flat."""


class SineRoute(FileStruct, frozen=True, kw_only=True, tag="sine", tag_field="kind"):
    """y = amplitude sin(2 pi x / wavelength), from x = 0."""

    amplitude_m: Annotated[float, Meta(ge=0, le=10, extra_json_schema={"unit": "m"})]
    """Amplitude of the sine along y."""

    wavelength_m: Size
    """Wavelength of the sine along x."""

    length_m: Size
    """Length of the route along x."""


class WaypointRoute(FileStruct, frozen=True, kw_only=True, tag="waypoints", tag_field="kind"):
    """Straight lines between points; use many points for a smooth curve."""

    points_m: Annotated[list[Point], Meta(min_length=2, max_length=20000)]
    """Points of the route in the world frame, as [x, y], from its start to its end."""


class Cylinder(Upright, frozen=True, kw_only=True):
    """A peg."""

    position_m: Point
    """Center of the foot in the world frame, as [x, y]."""

    radius_m: Size
    """Radius of the peg."""

    height_m: Size = 0.2
    """Height of the peg."""

    name: Name | None = None
    """Name, which no other obstacle has; none: `cylinder_` with its number in the file."""


class Box(Upright, frozen=True, kw_only=True):
    """A block."""

    position_m: Point
    """Center of the foot in the world frame, as [x, y]."""

    size_m: tuple[Size, Size, Size]
    """Length, width and height of the block."""

    yaw_rad: Heading = 0.0
    """Rotation about the vertical; 0: its length is along x."""

    name: Name | None = None
    """Name, which no other obstacle has; none: `box_` with its number in the file."""


class Sphere(Solid, frozen=True, kw_only=True):
    """A ball; one that slides does not roll."""

    position_m: Point
    """Center in the world frame, as [x, y]."""

    radius_m: Size
    """Radius of the ball."""

    center_height_m: Coordinate = 0.0
    """Height of the center above the ground."""

    name: Name | None = None
    """Name, which no other obstacle has; none: `sphere_` with its number in the file."""


class Wall(Upright, frozen=True, kw_only=True):
    """A straight wall between two points."""

    from_m: Point
    """One end of the wall in the world frame, as [x, y]."""

    to_m: Point
    """The other end of the wall in the world frame, as [x, y]."""

    thickness_m: Size = 0.05
    """Thickness of the wall."""

    height_m: Size = 0.3
    """Height of the wall."""

    name: Name | None = None
    """Name, which no other obstacle has; none: `wall_` with its number in the file."""


class Step(FileStruct, frozen=True, kw_only=True):
    """A low platform that the snake may lie on or climb."""

    position_m: Point
    """Center of the foot in the world frame, as [x, y]."""

    size_m: tuple[Size, Size]
    """Length and width of the platform."""

    height_m: Annotated[float, above(2, "m")]
    """Height of the platform."""

    yaw_rad: Heading = 0.0
    """Rotation about the vertical; 0: its length is along x."""

    friction: Friction = 0.5
    """Coulomb friction between the platform and the snake."""

    name: Name | None = None
    """Name, which no other obstacle has; none: `step_` with its number in the file."""


class PegsAlongRoute(Upright, frozen=True, kw_only=True):
    """Pegs beside the route where a snake can push off: at its inflections, on alternating sides.

    `corridor_m` is the distance from the route to a peg's surface, so a body of radius r has `corridor_m - r` of
    clearance on that side.
    """

    corridor_m: Size
    """Distance from the route to a peg's surface."""

    radius_m: Size
    """Radius of every peg."""

    count: Annotated[int, Meta(ge=1, le=2000)]
    """Number of pegs, one at each inflection of the route."""

    first: Annotated[int, Meta(ge=0, le=2000)] = 0
    """Number of inflections without a peg at the start of the route."""

    height_m: Size = 0.2
    """Height of every peg."""


SAMPLES = 24  # points along a link's axis at which the distance to obstacles is computed
OVERLAP_M = 1e-4  # a smaller overlap of an obstacle and a link is a rounding error
MAX_OBSTACLES = 4096  # bound of the message World


class ReferenceRobot(FileStruct, frozen=True, kw_only=True):
    """The body that a scene was laid out for; for another robot the scene is scaled in proportion, see fitting.py."""

    spacing_m: Size
    """Longest distance between two neighboring yaw joints."""

    radius_m: Size
    """Radius of the body."""


class SceneFile(FileStruct, frozen=True, kw_only=True):
    """A whole scene file."""

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern="^[A-Za-z0-9_-]+$")]
    """Name of the scene: letters, digits, `_` and `-`."""

    about: str = ""
    """Description in one line, which lists of scenes show."""

    ground: Ground
    """The ground, and its friction."""

    reference_robot: ReferenceRobot | None = None
    """Body that the scene was laid out for, and in proportion to which it is scaled; none: it is the same for every
    robot.
    """

    route: SineRoute | WaypointRoute | None = None
    """Route of the snake, `kind` = "sine" or "waypoints"; none: the scene has no route."""

    # Obstacles.
    cylinder: list[Cylinder] = []
    """Pegs, each an entry `[[cylinder]]`."""

    box: list[Box] = []
    """Blocks, each an entry `[[box]]`."""

    sphere: list[Sphere] = []
    """Balls, each an entry `[[sphere]]`."""

    wall: list[Wall] = []
    """Straight walls, each an entry `[[wall]]`."""

    step: list[Step] = []
    """Low platforms that the snake may lie on or climb, each an entry `[[step]]`."""

    pegs_along_route: list[PegsAlongRoute] = []
    """Rows of pegs beside the route, each an entry `[[pegs_along_route]]`."""

    random_field: list[RandomField] = []
    """Areas with randomly placed obstacles, each an entry `[[random_field]]`."""


def make_route(scene: SceneFile) -> Route | None:
    """Return the scene's route as a curve, or None if the scene has no route.

    Raises:
        ConfigError: The waypoints are not a line.
    """
    match scene.route:
        case None:
            return None
        case SineRoute(amplitude_m=amplitude, wavelength_m=wavelength, length_m=length):
            return Route(sine_points(amplitude, wavelength, length))
        case WaypointRoute(points_m=points):
            try:
                return Route(np.asarray(points))
            except ValueError as error:
                raise ConfigError(f"scene {scene.name!r}: `route.points_m`: {error}", code="scene/invalid") from None


class Placed(Upright, frozen=True, kw_only=True):
    """A placed obstacle, with parameters that only the simulator needs."""

    obstacle: Obstacle
    walkable: bool = False  # a step: part of the ground, so the snake does not push off from it


def place_scene(scene: SceneFile, keep_clear: list[Capsule] | None = None) -> list[Placed]:
    """Return all obstacles of a scene, with peg rows and random fields expanded, each with a unique name.

    Args:
        scene: the scene file.
        keep_clear: links of the snake at its start, from which random obstacles keep a distance.

    Raises:
        ConfigError: There are too many obstacles, one cannot be placed, or two have the same name.
    """
    _check_count(scene)
    placed: list[Placed] = [
        *(_placed_cylinder(i, cylinder) for i, cylinder in enumerate(scene.cylinder)),
        *(_placed_box(i, box) for i, box in enumerate(scene.box)),
        *(_placed_sphere(i, sphere) for i, sphere in enumerate(scene.sphere)),
        *(_placed_wall(scene, i, wall) for i, wall in enumerate(scene.wall)),
        *(_placed_step(i, step) for i, step in enumerate(scene.step)),
    ]
    route = make_route(scene)
    for i, row in enumerate(scene.pegs_along_route):
        placed += _pegs_along_route(scene, i, row, route)
    for i, field in enumerate(scene.random_field):
        placed += _obstacles_of_field(scene, i, field, route, placed, keep_clear or [])
    _check_names(scene, placed)
    return placed


def _check_count(scene: SceneFile) -> None:
    """Raise ConfigError if the scene has more obstacles than a message can hold."""
    single_obstacles = (scene.cylinder, scene.box, scene.sphere, scene.wall, scene.step)
    count = sum(len(obstacles) for obstacles in single_obstacles)
    count += sum(row.count for row in scene.pegs_along_route)
    count += sum(min(field.wanted, MAX_RANDOM_OBSTACLES) for field in scene.random_field)
    if count > MAX_OBSTACLES:
        raise ConfigError(
            f"scene {scene.name!r}: has {count} obstacles; at most {MAX_OBSTACLES} are allowed", code="scene/invalid"
        )


def _check_names(scene: SceneFile, placed: list[Placed]) -> None:
    """Raise ConfigError if two obstacles have the same name."""
    counts = Counter(item.obstacle.name for item in placed)
    duplicates = sorted(name for name, count in counts.items() if count > 1)
    if duplicates:
        raise ConfigError(
            f"scene {scene.name!r}: two obstacles are called {duplicates[0]!r}; rename one",
            code="config/duplicate-name",
        )


def _with_material(obstacle: Obstacle, solid: Solid) -> Placed:
    """Return a placed obstacle with the material and the lean that its section in the scene file gives."""
    return Placed(obstacle=obstacle, **material_fields(solid))


def _placed_cylinder(index: int, cylinder: Cylinder) -> Placed:
    name = cylinder.name or f"cylinder_{index}"
    obstacle = make_peg(name, cylinder.position_m, cylinder.radius_m, cylinder.height_m)
    return _with_material(obstacle, cylinder)


def _placed_box(index: int, box: Box) -> Placed:
    name = box.name or f"box_{index}"
    obstacle = make_block(name, box.position_m, box.size_m, box.yaw_rad)
    return _with_material(obstacle, box)


def _placed_sphere(index: int, sphere: Sphere) -> Placed:
    obstacle = Obstacle(
        name=sphere.name or f"sphere_{index}",
        shape="sphere",
        position_w=(*sphere.position_m, sphere.center_height_m),
        radius_m=sphere.radius_m,
        height_m=2 * sphere.radius_m,
    )
    return _with_material(obstacle, sphere)


def _placed_wall(scene: SceneFile, index: int, wall: Wall) -> Placed:
    """Return a wall as a block whose length is along the wall."""
    from_x, from_y = wall.from_m
    to_x, to_y = wall.to_m
    run_x = to_x - from_x
    run_y = to_y - from_y
    length_m = math.hypot(run_x, run_y)
    if length_m == 0:
        raise ConfigError(
            f"scene {scene.name!r}: `wall.{index}`: `from_m` and `to_m` are the same point", code="scene/invalid"
        )
    name = wall.name or f"wall_{index}"
    middle_m = ((from_x + to_x) / 2, (from_y + to_y) / 2)
    size_m = (length_m, wall.thickness_m, wall.height_m)
    obstacle = make_block(name, middle_m, size_m, math.atan2(run_y, run_x))
    return _with_material(obstacle, wall)


def _placed_step(index: int, step: Step) -> Placed:
    name = step.name or f"step_{index}"
    size_m = (*step.size_m, step.height_m)
    platform = make_block(name, step.position_m, size_m, step.yaw_rad)
    return Placed(obstacle=platform, friction=step.friction, walkable=True)


def _pegs_along_route(scene: SceneFile, index: int, row: PegsAlongRoute, route: Route | None) -> list[Placed]:
    """Return the pegs of one `[[pegs_along_route]]`: one at each inflection, on the side from which it pushes forward.

    Raises:
        ConfigError: The scene has no route, or the route has too few inflections.
    """
    where = f"scene {scene.name!r}: `pegs_along_route.{index}`"
    if route is None:
        raise ConfigError(f"{where}: the scene has no route; add a [route] section", code="scene/no-route")
    inflections_s_m = route.inflections_s_m()
    used_s_m = inflections_s_m[row.first : row.first + row.count]
    if len(used_s_m) < row.count:
        available = len(inflections_s_m)
        raise ConfigError(
            f"{where}: `count` = {row.count} pegs from inflection {row.first} on, but the route has {available} "
            f"inflections; make the route longer or `count` at most {max(available - row.first, 0)}",
            code="scene/invalid",
        )
    start_w, end_w = route.position_w(np.array([0.0, route.length_m]))
    forward = (end_w - start_w) / np.linalg.norm(end_w - start_w)
    pegs: list[Placed] = []
    for number, s_m in enumerate(used_s_m, start=row.first):
        tangent = route.tangent_w(s_m)
        left = np.array([-tangent[1], tangent[0]])
        is_forward = left @ forward > 0
        push_direction = left if is_forward else -left  # of the force from the peg on the body
        center = route.position_w(s_m) - push_direction * (row.corridor_m + row.radius_m)
        center_m = (float(center[0]), float(center[1]))
        obstacle = make_peg(f"peg_{index}_{number}", center_m, row.radius_m, row.height_m)
        pegs.append(_with_material(obstacle, row))
    return pegs


def _obstacles_of_field(
    scene: SceneFile,
    index: int,
    field: RandomField,
    route: Route | None,
    placed: list[Placed],
    keep_clear: list[Capsule],
) -> list[Placed]:
    """Return the obstacles of one random field, between those that are placed already."""
    where = f"scene {scene.name!r}: `random_field.{index}`"
    standing = [item.obstacle for item in placed if not item.walkable]
    obstacles = place_random_obstacles(field, where, index, route, standing, keep_clear)
    solids = make_solids(field, index, len(obstacles))
    return [_with_material(obstacle, solid) for obstacle, solid in zip(obstacles, solids, strict=True)]


def check_clear(scene: SceneFile, placed: list[Placed], snake: list[Capsule]) -> None:
    """Check that no obstacle overlaps the snake at its start.

    Args:
        scene: named in the error.
        placed: all obstacles; the snake may lie on walkable ones.
        snake: outlines of the links.

    Raises:
        ConfigError: An obstacle overlaps a link. It names both, and how far they overlap.
    """
    height_m = max(link.radius_m for link in snake)
    obstacles = [_at_height(item, height_m) for item in placed if not item.walkable]
    overlaps_m = _overlaps_m(snake, obstacles)
    for obstacle_index, link_index in np.argwhere(overlaps_m.T > OVERLAP_M)[:1]:
        overlap_mm = overlaps_m[link_index, obstacle_index] * 1000
        raise ConfigError(
            f"scene {scene.name!r}: obstacle {obstacles[obstacle_index].name!r} overlaps {snake[link_index].name} of "
            f"the snake at its start by {overlap_mm:.1f} mm; move the obstacle, give the pegs more `corridor_m`, or "
            f"change [start] in the scenario",
            code="scene/overlap",
        )


def _overlaps_m(snake: list[Capsule], obstacles: list[Obstacle]) -> Floats:
    """Return how far every link and obstacle overlap, (links, obstacles); negative where there is a gap.

    The distance of a link's axis from an obstacle's center is exact, which suffices for round obstacles. For boxes the
    distances from `SAMPLES` points along the axis are taken, too, and the smallest one counts.
    """
    outlines = Outlines.from_obstacles(obstacles)
    rear_w = np.array([link.rear_m for link in snake])
    front_w = np.array([link.front_m for link in snake])
    radius_m = np.array([link.radius_m for link in snake])
    fractions = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    points_w = rear_w[:, None] + fractions * (front_w - rear_w)[:, None]  # (links, SAMPLES, 2)
    from_points_m = outlines.distance_m(points_w).min(axis=1)
    from_axes_m = Outlines.from_segments(rear_w, front_w).distance_m(outlines.center_w).T - outlines.rounding_m
    gaps_m = np.minimum(from_points_m, from_axes_m)
    return radius_m[:, None] - gaps_m


def _at_height(item: Placed, height_m: float) -> Obstacle:
    """Return an obstacle at the position where its axis, which may lean, passes a height above the ground."""
    x, y, z = item.obstacle.position_w
    offset_m = height_m * math.tan(item.lean_rad)
    lean_x = x + offset_m * math.cos(item.lean_towards_rad)
    lean_y = y + offset_m * math.sin(item.lean_towards_rad)
    return msgspec.structs.replace(item.obstacle, position_w=(lean_x, lean_y, z))
