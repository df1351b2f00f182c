"""The pipes of a scene: their names, outlines from above, and what the snake's start and the ground require of them."""

import math
from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.outlines import CapsuleOutline
from snakesim_hal.model.scene_file.scene import SceneFile
from snakesim_hal.model.scene_file.solids import make_block
from snakesim_hal.model.scene_file.terrain import Pipe
from snakesim_hal.wire.messages import KnownObstacle

SAMPLES_PER_LINK = 24  # points along a link's axis whose distance from a pipe's axis is computed


def get_pipe_name(index: int, pipe: Pipe) -> str:
    """Return the name of a pipe of a scene."""
    return pipe.name or f"pipe_{index}"


def make_pipe_block(index: int, pipe: Pipe) -> KnownObstacle:
    """Return the block that has the outline of a pipe from above, and its height above the ground."""
    height_m = pipe.find_axis_height_m()
    if not pipe.open_top:
        height_m += pipe.radius_m
    size_m = (pipe.length_m, 2 * pipe.radius_m, max(height_m, 0.0))
    return make_block(get_pipe_name(index, pipe), pipe.position_m, size_m, pipe.yaw_rad)


def validate_pipes(scene: SceneFile, snake: Sequence[CapsuleOutline]) -> None:
    """Check that hollow pipes are hollow, lie on the ground, and do not overlap the snake at its start.

    Args:
        scene: Scene file.
        snake: Outlines of the snake's links at its start. A hollow pipe whose axis is over the snake must have room.

    Raises:
        ConfigError: A pipe cannot be built as the scene describes it, or the snake starts in its wall.
    """
    for i, pipe in enumerate(scene.pipe):
        context = f"scene {scene.name!r}: `pipe.{i}`"
        inner_radius_m = pipe.inner_radius_m
        if inner_radius_m is None:
            _validate_solid_pipe(pipe, context)
            continue
        _validate_hollow_pipe(pipe, inner_radius_m, context)
        for link in snake:
            _validate_start(pipe, inner_radius_m, link, context)


def _validate_solid_pipe(pipe: Pipe, context: str) -> None:
    if pipe.open_top:
        raise ConfigError(
            f"{context}: `open_top` is true, but the pipe is solid; set `inner_radius_m`, or leave `open_top` out",
            code="scene/invalid",
        )
    if pipe.length_m <= 2 * pipe.radius_m:
        raise ConfigError(
            f"{context}: `length_m` = {pipe.length_m:g} m must be more than the two round ends of a solid pipe, "
            f"2 * `radius_m` = {2 * pipe.radius_m:g} m; make it longer, or use a [[sphere]]",
            code="scene/invalid",
        )


def _validate_hollow_pipe(pipe: Pipe, inner_radius_m: float, context: str) -> None:
    if inner_radius_m >= pipe.radius_m:
        raise ConfigError(
            f"{context}: `inner_radius_m` = {inner_radius_m:g} m must be less than `radius_m` = {pipe.radius_m:g} m",
            code="scene/invalid",
        )
    if pipe.find_axis_height_m() < inner_radius_m:
        raise ConfigError(
            f"{context}: `axis_height_m` = {pipe.find_axis_height_m():g} m would let the ground into the pipe; set at "
            f"least `inner_radius_m` = {inner_radius_m:g} m",
            code="scene/invalid",
        )


def _validate_start(pipe: Pipe, inner_radius_m: float, link: CapsuleOutline, context: str) -> None:
    """Raise ConfigError if a link starts in the wall of a hollow pipe, as seen from above."""
    fractions = np.linspace(0.0, 1.0, SAMPLES_PER_LINK)[:, None]
    rear_m = np.array(link.rear_m)
    points_m = rear_m + fractions * (np.array(link.front_m) - rear_m) - np.array(pipe.position_m)
    direction = np.array([math.cos(pipe.yaw_rad), math.sin(pipe.yaw_rad)])
    along_m = np.abs(points_m @ direction)
    across_m = np.abs(points_m @ np.array([-direction[1], direction[0]]))
    is_inside = across_m <= inner_radius_m - link.radius_m
    is_outside = (across_m >= pipe.radius_m + link.radius_m) | (
        along_m >= pipe.length_m / 2 + link.radius_m
    )
    if np.all(is_inside | is_outside):
        return
    raise ConfigError(
        f"{context}: {link.name} of the snake, with a radius of {link.radius_m:g} m, starts in its wall; inside, "
        f"its axis must be within `inner_radius_m` minus that radius = {inner_radius_m - link.radius_m:g} m of the "
        f"pipe's axis. Change [start] in the scenario, or `inner_radius_m`",
        code="scene/overlap",
    )
