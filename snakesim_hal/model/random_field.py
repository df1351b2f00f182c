"""Randomly placed obstacles: upright pegs and blocks with a minimum gap between any two, the same for the same seed."""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.random import Generator

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.outlines import Capsule, Clearance, Outlines, Point, Size, gaps_m
from snakesim_hal.model.route import Route
from snakesim_hal.model.solids import MOST_LEAN_RAD, Solid, Upright, block, made_of, peg
from snakesim_hal.wire.messages import Obstacle

MAX_RANDOM_OBSTACLES = 1000
TRIES = 200  # for each obstacle that is wanted
LEANING = 1  # seeds the draw of it, which leaves the places as they are


class RandomField(Solid, frozen=True, kw_only=True):
    """Randomly placed pegs and blocks, the same for the same seed."""

    seed: Annotated[int, Meta(ge=0, le=2**31)]
    min_corner_m: Point  # corners of the area in which their centers are
    max_corner_m: Point
    density_per_m2: Annotated[float, Meta(gt=0, le=200, extra_json_schema={"unit": "1/m²"})]
    radius_m: tuple[Size, Size]  # of a peg, smallest and largest
    box_fraction: Annotated[float, Meta(ge=0, le=1)] = 0.0  # of all obstacles, on average; the others are pegs
    box_size_m: tuple[Size, Size] = (0.06, 0.18)  # length and width of a block, smallest and largest
    clearance_m: Clearance  # least gap between the surfaces of any two
    route_clearance_m: Clearance | None = None  # least gap between the route and a surface
    height_m: Size = 0.2
    # Each leans by up to so much, in a direction of its own.
    lean_up_to_rad: Annotated[float, Meta(ge=0, le=MOST_LEAN_RAD, extra_json_schema={"unit": "rad"})] = 0.0

    @property
    def wanted(self) -> int:
        """Number of obstacles."""
        return round(self.density_per_m2 * math.prod(np.subtract(self.max_corner_m, self.min_corner_m).tolist()))


def solids_of(field: RandomField, index: int, count: int) -> list[Upright]:
    """What the obstacles of a field are made of, and how each leans. index: of the field in the scene."""
    random = np.random.default_rng([field.seed, index, LEANING])
    drawn = random.uniform((0.0, -math.pi), (field.lean_up_to_rad, math.pi), (count, 2))
    return [Upright(**made_of(field), lean_rad=lean, lean_towards_rad=towards) for lean, towards in drawn.tolist()]


def random_obstacles(
    field: RandomField,
    where: str,
    index: int,
    route: Route | None,
    standing: Sequence[Obstacle],
    keep_clear: Sequence[Capsule],
) -> list[Obstacle]:
    """The obstacles of a field. where: the field, for errors; index: its number in the scene, which also seeds it.

    standing: obstacles that are there already; keep_clear: the snake at its start.
    """
    _check(field, where, route)
    random = np.random.default_rng([field.seed, index])
    kept = [_snake(keep_clear, field.clearance_m)] if keep_clear else []
    if route is not None and field.route_clearance_m is not None:
        kept.append(Outlines.of_segments(route.points_w[:-1], route.points_w[1:], field.route_clearance_m))
    placed: list[Obstacle] = []
    others = Outlines.of(standing)
    for _ in range(TRIES * field.wanted):
        if len(placed) == field.wanted:
            return placed
        tried = _draw(field, random, f"random_{index}_{len(placed)}")
        outline = Outlines.of([tried])
        if len(others) and gaps_m(outline, others).min() < field.clearance_m:
            continue
        if any(gaps_m(outline, free).min() < 0.0 for free in kept):
            continue
        placed.append(tried)
        others = Outlines.of([*standing, *placed])
    if len(placed) < field.wanted:
        raise ConfigError(
            f"{where}: only {len(placed)} of {field.wanted} pegs fit; lower `density_per_m2` = "
            f"{field.density_per_m2} or `clearance_m` = {field.clearance_m}"
        )
    return placed


def _snake(links: Sequence[Capsule], clearance_m: float) -> Outlines:
    from_w, to_w = np.array([c.rear_m for c in links]), np.array([c.front_m for c in links])
    return Outlines.of_segments(from_w, to_w, max(c.radius_m for c in links) + clearance_m)


def _check(field: RandomField, where: str, route: Route | None) -> None:
    if not np.all(np.array(field.max_corner_m) > np.array(field.min_corner_m)):
        raise ConfigError(
            f"{where}: `max_corner_m` = {field.max_corner_m} must exceed `min_corner_m` = "
            f"{field.min_corner_m} in x and y"
        )
    for name in ("radius_m", "box_size_m"):
        sizes = getattr(field, name)
        if sizes[1] < sizes[0]:
            raise ConfigError(f"{where}: `{name}` = {sizes}: smallest first, then largest")
    if field.route_clearance_m is not None and route is None:
        raise ConfigError(f"{where}: `route_clearance_m` is set but the scene has no route; add a [route] section")
    if field.wanted > MAX_RANDOM_OBSTACLES:
        raise ConfigError(
            f"{where}: `density_per_m2` = {field.density_per_m2} asks for {field.wanted} pegs on this area; at most "
            f"{MAX_RANDOM_OBSTACLES}"
        )


def _draw(field: RandomField, random: Generator, name: str) -> Obstacle:
    x, y = random.uniform(field.min_corner_m, field.max_corner_m).tolist()
    radius_m = float(random.uniform(*field.radius_m))
    if field.box_fraction == 0 or random.uniform() >= field.box_fraction:
        return peg(name, (x, y), radius_m, field.height_m)
    length_m, width_m = random.uniform(*field.box_size_m, size=2).tolist()
    return block(name, (x, y), (length_m, width_m, field.height_m), float(random.uniform(0.0, math.pi)))
