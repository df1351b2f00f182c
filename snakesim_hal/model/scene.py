"""The scene file: ground, obstacles, and the route of the snake through them.

The simulator builds it, guidance uses it as its map, the report draws it. `place` expands peg rows and random
fields into plain obstacles; `check_clear` rejects a scene in which one of them overlaps the snake's start pose.
"""

import math
from collections import Counter
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.outlines import Capsule, Coordinate, Friction, Heading, Outlines, Point, Size
from snakesim_hal.model.random_field import MAX_RANDOM_OBSTACLES, RandomField, random_obstacles, solids_of
from snakesim_hal.model.route import Route, sine_points
from snakesim_hal.model.solids import Solid, Upright, block, made_of, peg
from snakesim_hal.wire.messages import Obstacle
from snakesim_hal.wire.quantities import Name, above


class Heightfield(FileStruct, frozen=True, kw_only=True):
    """Smooth random hills."""

    height_m: Annotated[float, above(1, "m")]  # from lowest to highest point
    wavelength_m: Annotated[float, above(100, "m")]  # typical distance between two hills
    area_m: Annotated[float, above(200, "m")] = 20.0  # edge of the square around the origin
    seed: Annotated[int, Meta(ge=0, le=2**31)] = 0


class Ground(FileStruct, frozen=True, kw_only=True):
    """The ground, and its friction."""

    friction: Friction
    heightfield: Heightfield | None = None


class SineRoute(FileStruct, frozen=True, kw_only=True, tag="sine", tag_field="kind"):
    """y = amplitude sin(2 pi x / wavelength), from x = 0."""

    amplitude_m: Annotated[float, Meta(ge=0, le=10, extra_json_schema={"unit": "m"})]
    wavelength_m: Size
    length_m: Size  # along x


class WaypointRoute(FileStruct, frozen=True, kw_only=True, tag="waypoints", tag_field="kind"):
    """Straight lines between points; use many points for a smooth curve."""

    points_m: Annotated[list[Point], Meta(min_length=2, max_length=20000)]


class Cylinder(Upright, frozen=True, kw_only=True):
    """A peg."""

    position_m: Point
    radius_m: Size
    height_m: Size = 0.2
    name: Name | None = None


class Box(Upright, frozen=True, kw_only=True):
    """A block."""

    position_m: Point
    size_m: tuple[Size, Size, Size]
    yaw_rad: Heading = 0.0
    name: Name | None = None


class Sphere(Solid, frozen=True, kw_only=True):
    """A ball; one that slides does not roll."""

    position_m: Point
    radius_m: Size
    center_height_m: Coordinate = 0.0
    name: Name | None = None


class Wall(Upright, frozen=True, kw_only=True):
    """A straight wall from point to point."""

    from_m: Point
    to_m: Point
    thickness_m: Size = 0.05
    height_m: Size = 0.3
    name: Name | None = None


class Step(FileStruct, frozen=True, kw_only=True):
    """A low platform that the snake may lie on or climb."""

    position_m: Point
    size_m: tuple[Size, Size]
    height_m: Annotated[float, above(2, "m")]
    yaw_rad: Heading = 0.0
    friction: Friction = 0.5
    name: Name | None = None


class PegsAlongRoute(Upright, frozen=True, kw_only=True):
    """Pegs beside the route where a snake can push off: at its inflections, on alternating sides.

    `corridor_m` is the distance from the route to a peg's surface, so a body of radius r has `corridor_m - r` of
    clearance on that side.
    """

    corridor_m: Size
    radius_m: Size
    count: Annotated[int, Meta(ge=1, le=2000)]
    first: Annotated[int, Meta(ge=0, le=2000)] = 0  # inflections to skip at the start
    height_m: Size = 0.2


SAMPLES = 24  # of a link's axis, of which the nearest to a box counts
OVERLAP_M = 1e-4  # of an obstacle and a link, that is let pass
MAX_OBSTACLES = 4096  # bound of the message World


class Body(FileStruct, frozen=True, kw_only=True):
    """The body that a scene was laid out for: another robot gets the scene in proportion, see fitting.py."""

    spacing_m: Size  # between neighboring yaw joints
    radius_m: Size


class SceneFile(FileStruct, frozen=True, kw_only=True):
    """A whole scene file."""

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern="^[A-Za-z0-9_-]+$")]
    about: str = ""
    ground: Ground
    reference_robot: Body | None = None
    route: SineRoute | WaypointRoute | None = None
    cylinder: list[Cylinder] = []
    box: list[Box] = []
    sphere: list[Sphere] = []
    wall: list[Wall] = []
    step: list[Step] = []
    pegs_along_route: list[PegsAlongRoute] = []
    random_field: list[RandomField] = []


def route_of(scene: SceneFile) -> Route | None:
    """The scene's route as a curve, or None when it has none."""
    match scene.route:
        case None:
            return None
        case SineRoute(amplitude_m=amplitude, wavelength_m=wavelength, length_m=length):
            return Route(sine_points(amplitude, wavelength, length))
        case WaypointRoute(points_m=points):
            try:
                return Route(np.asarray(points))
            except ValueError as error:
                raise ConfigError(f"scene {scene.name!r}: `route.points_m`: {error}") from None


class Placed(Upright, frozen=True, kw_only=True):
    """A placed obstacle, with parameters that only the simulator needs."""

    obstacle: Obstacle
    walkable: bool = False  # a step is part of the ground: contacts with it are not for pushing off


def _placed(obstacle: Obstacle, solid: Solid) -> Placed:
    return Placed(obstacle=obstacle, **made_of(solid))


def place(scene: SceneFile, keep_clear: list[Capsule] | None = None) -> list[Placed]:
    """All obstacles of a scene, expanded, each with a unique name.

    keep_clear: capsules (the snake at its start) that random fields stay away from.
    """
    _check_count(scene)
    placed: list[Placed] = []
    for i, c in enumerate(scene.cylinder):
        placed.append(_placed(peg(c.name or f"cylinder_{i}", c.position_m, c.radius_m, c.height_m), c))
    for i, b in enumerate(scene.box):
        placed.append(_placed(block(b.name or f"box_{i}", b.position_m, b.size_m, b.yaw_rad), b))
    for i, s in enumerate(scene.sphere):
        ball = Obstacle(
            name=s.name or f"sphere_{i}",
            shape="sphere",
            position_w=(*s.position_m, s.center_height_m),
            radius_m=s.radius_m,
            height_m=2 * s.radius_m,
        )
        placed.append(_placed(ball, s))
    for i, w in enumerate(scene.wall):
        run = (w.to_m[0] - w.from_m[0], w.to_m[1] - w.from_m[1])
        length = math.hypot(*run)
        if length == 0:
            raise ConfigError(f"scene {scene.name!r}: `wall.{i}`: `from_m` and `to_m` are the same point")
        middle = ((w.from_m[0] + w.to_m[0]) / 2, (w.from_m[1] + w.to_m[1]) / 2)
        size = (length, w.thickness_m, w.height_m)
        placed.append(_placed(block(w.name or f"wall_{i}", middle, size, math.atan2(run[1], run[0])), w))
    for i, p in enumerate(scene.step):
        size = (*p.size_m, p.height_m)
        platform = block(p.name or f"step_{i}", p.position_m, size, p.yaw_rad)
        placed.append(Placed(obstacle=platform, friction=p.friction, walkable=True))
    route = route_of(scene)
    for i, row in enumerate(scene.pegs_along_route):
        placed.extend(_pegs_along(scene, i, row, route))
    for i, field in enumerate(scene.random_field):
        standing = [p.obstacle for p in placed if not p.walkable]
        found = random_obstacles(
            field, f"scene {scene.name!r}: `random_field.{i}`", i, route, standing, keep_clear or []
        )
        placed.extend(map(_placed, found, solids_of(field, i, len(found))))
    names = Counter(p.obstacle.name for p in placed)
    twice = sorted(name for name, count in names.items() if count > 1)
    if twice:
        raise ConfigError(f"scene {scene.name!r}: two obstacles are called {twice[0]!r}; rename one")
    return placed


def _check_count(scene: SceneFile) -> None:
    given = (scene.cylinder, scene.box, scene.sphere, scene.wall, scene.step)
    count = sum(len(kind) for kind in given) + sum(row.count for row in scene.pegs_along_route)
    count += sum(min(field.wanted, MAX_RANDOM_OBSTACLES) for field in scene.random_field)
    if count > MAX_OBSTACLES:
        raise ConfigError(f"scene {scene.name!r}: has {count} obstacles; at most {MAX_OBSTACLES} are allowed")


def _pegs_along(scene: SceneFile, index: int, row: PegsAlongRoute, route: Route | None) -> list[Placed]:
    where = f"scene {scene.name!r}: `pegs_along_route.{index}`"
    if route is None:
        raise ConfigError(f"{where}: the scene has no route; add a [route] section")
    spots = route.inflections_s_m()[row.first : row.first + row.count]
    if len(spots) < row.count:
        have = len(route.inflections_s_m())
        raise ConfigError(
            f"{where}: `count` = {row.count} pegs from inflection {row.first} on, but the route has {have} "
            f"inflections; make the route longer or `count` at most {max(have - row.first, 0)}"
        )
    ends = route.position_w(np.array([0.0, route.length_m]))
    forward = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    pegs: list[Placed] = []
    for k, s in enumerate(spots):
        tangent = route.tangent_w(s)
        left = np.array([-tangent[1], tangent[0]])
        push = left if left @ forward > 0 else -left  # from the peg into the body
        center = route.position_w(s) - push * (row.corridor_m + row.radius_m)
        name = f"peg_{index}_{row.first + k}"
        pegs.append(_placed(peg(name, (float(center[0]), float(center[1])), row.radius_m, row.height_m), row))
    return pegs


def check_clear(scene: SceneFile, placed: list[Placed], snake: list[Capsule]) -> None:
    """Raise ConfigError when an obstacle overlaps the snake's start."""
    height_m = max(link.radius_m for link in snake)
    solid = [_where_it_lies(item, height_m) for item in placed if not item.walkable]
    obstacles = Outlines.of(solid)
    rear, front = np.array([link.rear_m for link in snake]), np.array([link.front_m for link in snake])
    along = rear[:, None] + np.linspace(0.0, 1.0, SAMPLES)[:, None] * (front - rear)[:, None]  # (links, SAMPLES, 2)
    to_middles = Outlines.of_segments(rear, front).distance_m(obstacles.center_w).T - obstacles.rounding_m
    gaps = np.minimum(obstacles.distance_m(along).min(axis=1), to_middles)  # (links, obstacles), from the links' axes
    overlaps = np.array([link.radius_m for link in snake])[:, None] - gaps
    for k, i in np.argwhere(overlaps.T > OVERLAP_M)[:1]:
        raise ConfigError(
            f"scene {scene.name!r}: obstacle {solid[k].name!r} overlaps {snake[i].name} of the snake at its start by "
            f"{overlaps[i, k] * 1000:.1f} mm; move the obstacle, give the pegs more `corridor_m`, or change [start] in "
            f"the scenario"
        )


def _where_it_lies(item: Placed, height_m: float) -> Obstacle:
    """An obstacle where its axis passes this height above the ground."""
    x, y, z = item.obstacle.position_w
    aside_m = height_m * math.tan(item.lean_rad)
    x, y = x + aside_m * math.cos(item.lean_towards_rad), y + aside_m * math.sin(item.lean_towards_rad)
    return msgspec.structs.replace(item.obstacle, position_w=(x, y, z))
