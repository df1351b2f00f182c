"""Randomly placed obstacles: upright pegs and blocks with a minimum gap between any two, the same for the same seed."""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.random import Generator

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.outlines import Capsule, Clearance, Outlines, Point, Size, has_gap_below
from snakesim_hal.model.route import Route
from snakesim_hal.model.solids import MAX_LEAN_RAD, Solid, Upright, make_block, make_peg, material_fields
from snakesim_hal.wire.messages import Obstacle

MAX_RANDOM_OBSTACLES = 1000
TRIES = 200  # random positions that are tried for each obstacle
LEANING = 1  # third part of the seed of the leans, so that they do not change the positions


class RandomField(Solid, frozen=True, kw_only=True):
    """Randomly placed pegs and blocks, the same for the same seed."""

    seed: Annotated[int, Meta(ge=0, le=2**31)]
    """Seed of the positions, sizes and leans. The same seed gives the same obstacles."""

    min_corner_m: Point
    """Corner with the smallest coordinates of the rectangle that contains the centers of all obstacles, as [x, y]."""

    max_corner_m: Point
    """Corner with the largest coordinates of that rectangle, as [x, y]."""

    density_per_m2: Annotated[float, Meta(gt=0, le=200, extra_json_schema={"unit": "1/m²"})]
    """Number of obstacles for each square meter of the rectangle."""

    # Sizes: minimum and maximum.
    radius_m: tuple[Size, Size]
    """Minimum and maximum of the radius of a peg."""

    box_fraction: Annotated[float, Meta(ge=0, le=1)] = 0.0
    """Mean fraction of blocks among the obstacles. The others are pegs."""

    box_size_m: tuple[Size, Size] = (0.06, 0.18)
    """Minimum and maximum of the length and of the width of a block."""

    clearance_m: Clearance
    """Minimum gap between the surfaces of two obstacles."""

    route_clearance_m: Clearance | None = None
    """Minimum gap between the route and the surface of an obstacle. None: no such gap."""

    height_m: Size = 0.2
    """Height of every obstacle."""

    lean_up_to_rad: Annotated[float, Meta(ge=0, le=MAX_LEAN_RAD, extra_json_schema={"unit": "rad"})] = 0.0
    """Maximum angle by which an obstacle leans, in a random direction. 0: all are upright."""

    @property
    def target_count(self) -> int:
        """Return the number of obstacles that the density asks for on this area."""
        min_x, min_y = self.min_corner_m
        max_x, max_y = self.max_corner_m
        area_m2 = (max_x - min_x) * (max_y - min_y)
        return round(self.density_per_m2 * area_m2)


def make_solids(field: RandomField, index: int, count: int) -> list[Upright]:
    """Return the material and the random lean of every obstacle of a field.

    Args:
        field: the random field.
        index: its number in the scene, which is part of the seed.
        count: number of its obstacles.
    """
    random = np.random.default_rng([field.seed, index, LEANING])
    leans = random.uniform((0.0, -math.pi), (field.lean_up_to_rad, math.pi), (count, 2))
    material = material_fields(field)
    return [
        Upright(**material, lean_rad=lean_rad, lean_towards_rad=towards_rad) for lean_rad, towards_rad in leans.tolist()
    ]


def place_random_obstacles(
    field: RandomField,
    where: str,
    index: int,
    route: Route | None,
    standing: Sequence[Obstacle],
    keep_clear: Sequence[Capsule],
) -> list[Obstacle]:
    """Place the obstacles of a random field by rejection sampling.

    Args:
        field: the random field.
        where: names the field in errors.
        index: number of the field in the scene, which is part of the seed.
        route: route of the scene.
        standing: obstacles that are placed already.
        keep_clear: outlines of the snake at its start.

    Raises:
        ConfigError: A value of the field is not allowed, or too few obstacles fit.
    """
    _check(field, where, route)
    random = np.random.default_rng([field.seed, index])
    free_areas = _areas_to_keep_free(field, route, keep_clear)
    placed: list[Obstacle] = []
    others = Outlines.from_obstacles(standing)
    for _ in range(TRIES * field.target_count):
        if len(placed) == field.target_count:
            return placed
        candidate = _random_obstacle(field, random, f"random_{index}_{len(placed)}")
        outline = Outlines.from_obstacles([candidate])
        if len(others) and has_gap_below(outline, others, field.clearance_m):
            continue
        if any(has_gap_below(outline, area, 0.0) for area in free_areas):
            continue
        placed.append(candidate)
        others = others.append(outline)
    if len(placed) < field.target_count:
        raise ConfigError(
            f"{where}: only {len(placed)} of {field.target_count} pegs fit; lower `density_per_m2` = "
            f"{field.density_per_m2} or `clearance_m` = {field.clearance_m}",
            code="scene/invalid",
        )
    return placed


def _areas_to_keep_free(field: RandomField, route: Route | None, snake: Sequence[Capsule]) -> list[Outlines]:
    """Return the outlines that no obstacle may overlap: snake and route, each grown by its clearance."""
    areas: list[Outlines] = []
    if snake:
        rear_w = np.array([link.rear_m for link in snake])
        front_w = np.array([link.front_m for link in snake])
        radius_m = max(link.radius_m for link in snake)
        areas.append(Outlines.from_segments(rear_w, front_w, radius_m + field.clearance_m))
    if route is not None and field.route_clearance_m is not None:
        areas.append(Outlines.from_segments(route.points_w[:-1], route.points_w[1:], field.route_clearance_m))
    return areas


def _check(field: RandomField, where: str, route: Route | None) -> None:
    """Check values of a random field that depend on one another.

    Args:
        field: the random field.
        where: names the field in errors.
        route: route of the scene, if it has one.

    Raises:
        ConfigError: corners or sizes are out of order, a route is missing, or there would be too many obstacles.
    """
    if not np.all(np.array(field.max_corner_m) > np.array(field.min_corner_m)):
        raise ConfigError(
            f"{where}: `max_corner_m` = {field.max_corner_m} must exceed `min_corner_m` = "
            f"{field.min_corner_m} in x and y",
            code="scene/invalid",
        )
    for name in ("radius_m", "box_size_m"):
        sizes = getattr(field, name)
        min_size, max_size = sizes
        if max_size < min_size:
            raise ConfigError(f"{where}: `{name}` = {sizes}: smallest first, then largest", code="scene/invalid")
    if field.route_clearance_m is not None and route is None:
        raise ConfigError(
            f"{where}: `route_clearance_m` is set but the scene has no route; add a [route] section",
            code="scene/no-route",
        )
    if field.target_count > MAX_RANDOM_OBSTACLES:
        raise ConfigError(
            f"{where}: `density_per_m2` = {field.density_per_m2} means {field.target_count} pegs on this area; at most "
            f"{MAX_RANDOM_OBSTACLES}",
            code="scene/invalid",
        )


def _random_obstacle(field: RandomField, random: Generator, name: str) -> Obstacle:
    """Return a peg or a block at a random position in the field.

    The order of the random numbers is part of the result: a scene is the same for the same seed.
    """
    x, y = random.uniform(field.min_corner_m, field.max_corner_m).tolist()
    radius_m = float(random.uniform(*field.radius_m))
    if field.box_fraction == 0 or random.uniform() >= field.box_fraction:
        return make_peg(name, (x, y), radius_m, field.height_m)
    length_m, width_m = random.uniform(*field.box_size_m, size=2).tolist()
    yaw_rad = float(random.uniform(0.0, math.pi))
    return make_block(name, (x, y), (length_m, width_m, field.height_m), yaw_rad)
