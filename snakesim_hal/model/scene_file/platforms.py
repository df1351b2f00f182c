"""Blocks that the snake may lie on: single steps, stairs, and platforms with gaps between them."""

import math
from typing import NamedTuple

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.outlines import Point
from snakesim_hal.model.scene_file.scene import SceneFile, Step
from snakesim_hal.model.scene_file.solids import make_block
from snakesim_hal.model.scene_file.terrain import Gaps, Stairs
from snakesim_hal.wire.messages import KnownObstacle

MAX_LANDING_M = 2.0  # height, as of a single step


class Platform(NamedTuple):
    """A block at its place, and the section that describes its surface."""

    block: KnownObstacle
    surface: Step | Stairs | Gaps


def count_platforms(scene: SceneFile) -> int:
    """Return how many blocks steps, stairs and gaps make."""
    return (
        len(scene.step)
        + sum(stairs.count for stairs in scene.stairs)
        + sum(row.count + 1 for row in scene.gaps)
    )


def make_platforms(scene: SceneFile) -> list[Platform]:
    """Make the blocks of all steps, stairs and gaps of a scene.

    Raises:
        ConfigError: Stairs are too high.
    """
    platforms = [_make_step(i, step) for i, step in enumerate(scene.step)]
    for i, stairs in enumerate(scene.stairs):
        platforms += _make_stairs(scene.name, i, stairs)
    for i, row in enumerate(scene.gaps):
        platforms += _make_row_with_gaps(i, row)
    return platforms


def _make_step(index: int, step: Step) -> Platform:
    name = step.name or f"step_{index}"
    size_m = (*step.size_m, step.height_m)
    return Platform(make_block(name, step.position_m, size_m, step.yaw_rad), step)


def _make_stairs(scene: str, index: int, stairs: Stairs) -> list[Platform]:
    """Make the steps of a flight. Each reaches down to the ground, and from its edge to that of the next one."""
    height_m = stairs.count * stairs.rise_m
    if height_m > MAX_LANDING_M:
        max_count = int(MAX_LANDING_M / stairs.rise_m)
        raise ConfigError(
            f"scene {scene!r}: `stairs.{index}`: `count` = {stairs.count} steps of `rise_m` = {stairs.rise_m:g} m are "
            f"{height_m:g} m high; at most {MAX_LANDING_M:g} m are allowed. Set `count` to at most {max_count}, or "
            f"lower `rise_m`",
            code="scene/invalid",
        )
    name = stairs.name or f"stairs_{index}"
    platforms: list[Platform] = []
    for i in range(stairs.count):
        depth_m = stairs.landing_m if i == stairs.count - 1 else stairs.run_m
        middle_m = _move_along(stairs.position_m, stairs.yaw_rad, i * stairs.run_m + depth_m / 2)
        size_m = (depth_m, stairs.width_m, (i + 1) * stairs.rise_m)
        platforms.append(
            Platform(make_block(f"{name}_{i}", middle_m, size_m, stairs.yaw_rad), stairs)
        )
    return platforms


def _make_row_with_gaps(index: int, row: Gaps) -> list[Platform]:
    name = row.name or f"gaps_{index}"
    size_m = (row.platform_m, row.width_m, row.depth_m)
    platforms: list[Platform] = []
    for i in range(row.count + 1):
        middle_m = _move_along(
            row.position_m, row.yaw_rad, i * (row.platform_m + row.gap_m) + row.platform_m / 2
        )
        platforms.append(Platform(make_block(f"{name}_{i}", middle_m, size_m, row.yaw_rad), row))
    return platforms


def _move_along(point_m: Point, yaw_rad: float, distance_m: float) -> Point:
    """Return the point at a distance from another one, in a direction."""
    x, y = point_m
    return x + distance_m * math.cos(yaw_rad), y + distance_m * math.sin(yaw_rad)
