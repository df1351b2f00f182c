"""Randomly placed obstacles: upright pegs and blocks with a minimum gap between any two, the same for the same seed."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.outlines import (
    CapsuleOutline,
    Clearance,
    ObstacleOutlines,
    Point,
    Size,
    has_gap_below,
)
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.model.scene_file.solids import (
    MAX_LEAN_RAD,
    SolidObstacle,
    UprightSolid,
    get_material_fields,
    make_block,
    make_peg,
)
from snakesim_hal.wire.messages import KnownObstacle

if TYPE_CHECKING:
    from numpy.random import Generator  # takes 10 ms, and most processes place no obstacles

MAX_RANDOM_OBSTACLES = 1000
MAX_TRIES_PER_OBSTACLE = 200  # random positions that are tried for each obstacle
LEAN_SEED = 1  # third part of the seed of the leans, so that they do not change the positions


class RandomField(SolidObstacle, frozen=True, kw_only=True):
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

    lean_up_to_rad: Annotated[
        float, Meta(ge=0, le=MAX_LEAN_RAD, extra_json_schema={"unit": "rad"})
    ] = 0.0
    """Maximum angle by which an obstacle leans, in a random direction. 0: all are upright."""

    @property
    def target_count(self) -> int:
        """Return the number of obstacles that the density asks for on this area."""
        min_x, min_y = self.min_corner_m
        max_x, max_y = self.max_corner_m
        area_m2 = (max_x - min_x) * (max_y - min_y)
        return round(self.density_per_m2 * area_m2)


def sample_materials_and_leans(field: RandomField, index: int, count: int) -> list[UprightSolid]:
    """Return the material and a random lean for every obstacle of a random field.

    Args:
        field: Section of the random field.
        index: Index of the field in the scene, which is part of the seed.
        count: Number of obstacles in the field.
    """
    rng = np.random.default_rng([field.seed, index, LEAN_SEED])
    leans = rng.uniform((0.0, -math.pi), (field.lean_up_to_rad, math.pi), (count, 2))
    material = get_material_fields(field)
    return [
        UprightSolid(**material, lean_rad=lean_rad, lean_towards_rad=towards_rad)
        for lean_rad, towards_rad in leans.tolist()
    ]


def place_random_obstacles(
    field: RandomField,
    context: str,
    index: int,
    route: Route | None,
    existing_obstacles: Sequence[KnownObstacle],
    snake_capsules: Sequence[CapsuleOutline],
) -> list[KnownObstacle]:
    """Place the obstacles of a random field by rejection sampling.

    Args:
        field: Section of the random field.
        context: Place of the field in the scene file, which errors begin with.
        index: Index of the field in the scene, which is part of the seed.
        route: Route of the scene, or None if it has none.
        existing_obstacles: Obstacles that are placed already.
        snake_capsules: Outlines of the snake's links at its start.

    Raises:
        ConfigError: A value of the field is not allowed, or too few obstacles fit.
    """
    _validate_field(field, context, route)
    rng = np.random.default_rng([field.seed, index])
    exclusion_zones = _make_exclusion_zones(field, route, snake_capsules)
    placed: list[KnownObstacle] = []
    placed_outlines = ObstacleOutlines.from_obstacles(existing_obstacles)
    for _ in range(MAX_TRIES_PER_OBSTACLE * field.target_count):
        if len(placed) == field.target_count:
            return placed
        candidate = _sample_obstacle(field, rng, f"random_{index}_{len(placed)}")
        outline = ObstacleOutlines.from_obstacles([candidate])
        if len(placed_outlines) and has_gap_below(outline, placed_outlines, field.clearance_m):
            continue
        if any(has_gap_below(outline, zone, 0.0) for zone in exclusion_zones):
            continue
        placed.append(candidate)
        placed_outlines = placed_outlines.append(outline)
    if len(placed) < field.target_count:
        raise ConfigError(
            f"{context}: only {len(placed)} of {field.target_count} pegs fit; lower `density_per_m2` = "
            f"{field.density_per_m2} or `clearance_m` = {field.clearance_m}",
            code="scene/invalid",
        )
    return placed


def _make_exclusion_zones(
    field: RandomField, route: Route | None, snake: Sequence[CapsuleOutline]
) -> list[ObstacleOutlines]:
    """Return the outlines that no obstacle may overlap: snake and route, each grown by its clearance."""
    zones: list[ObstacleOutlines] = []
    if snake:
        rear_w = np.array([link.rear_m for link in snake])
        front_w = np.array([link.front_m for link in snake])
        radius_m = max(link.radius_m for link in snake)
        zones.append(ObstacleOutlines.from_segments(rear_w, front_w, radius_m + field.clearance_m))
    if route is not None and field.route_clearance_m is not None:
        zones.append(
            ObstacleOutlines.from_segments(
                route.points_w[:-1], route.points_w[1:], field.route_clearance_m
            )
        )
    return zones


def _validate_field(field: RandomField, context: str, route: Route | None) -> None:
    """Raise ConfigError for values of a random field that contradict each other.

    Args:
        field: Section of the random field.
        context: Place of the field in the scene file, which errors begin with.
        route: Route of the scene, or None if it has none.

    Raises:
        ConfigError: Corners or sizes are out of order, a route is missing, or there would be too many obstacles.
    """
    if not np.all(np.array(field.max_corner_m) > np.array(field.min_corner_m)):
        raise ConfigError(
            f"{context}: `max_corner_m` = {field.max_corner_m} must exceed `min_corner_m` = "
            f"{field.min_corner_m} in x and y",
            code="scene/invalid",
        )
    for name in ("radius_m", "box_size_m"):
        sizes = getattr(field, name)
        min_size, max_size = sizes
        if max_size < min_size:
            raise ConfigError(
                f"{context}: `{name}` = {sizes}: smallest first, then largest", code="scene/invalid"
            )
    if field.route_clearance_m is not None and route is None:
        raise ConfigError(
            f"{context}: `route_clearance_m` is set but the scene has no route; add a [route] section",
            code="scene/no-route",
        )
    if field.target_count > MAX_RANDOM_OBSTACLES:
        raise ConfigError(
            f"{context}: `density_per_m2` = {field.density_per_m2} means {field.target_count} pegs on this area; at "
            f"most {MAX_RANDOM_OBSTACLES}",
            code="scene/invalid",
        )


def _sample_obstacle(field: RandomField, rng: "Generator", name: str) -> KnownObstacle:
    """Sample a peg or a block at a random position in the field.

    The order of the random numbers is part of the result: a scene is the same for the same seed.
    """
    x, y = rng.uniform(field.min_corner_m, field.max_corner_m).tolist()
    radius_m = float(rng.uniform(*field.radius_m))
    if field.box_fraction == 0 or rng.uniform() >= field.box_fraction:
        return make_peg(name, (x, y), radius_m, field.height_m)
    length_m, width_m = rng.uniform(*field.box_size_m, size=2).tolist()
    yaw_rad = float(rng.uniform(0.0, math.pi))
    return make_block(name, (x, y), (length_m, width_m, field.height_m), yaw_rad)
