"""Stairs, gaps and pipes of a scene consist of blocks, and invalid ones are refused."""

import math
from typing import Any

import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.geometry.outlines import CapsuleOutline, ObstacleOutlines
from snakesim_hal.model.scene_file.placement import (
    outline_pipes,
    place_scene_obstacles,
    validate_start_clearance,
)
from snakesim_hal.model.scene_file.scene import SceneFile
from snakesim_testing.hal.small_robots import SCENE
from snakesim_testing.messages import raises_error

STAIRS: dict[str, Any] = {
    "position_m": [1.0, 2.0],
    "count": 3,
    "rise_m": 0.1,
    "run_m": 0.3,
    "width_m": 2.0,
}
GAPS: dict[str, Any] = {
    "position_m": [-0.5, 0.0],
    "count": 2,
    "gap_m": 0.25,
    "depth_m": 0.2,
    "platform_m": 1.0,
    "width_m": 2.0,
}
PIPE: dict[str, Any] = {
    "position_m": [0.0, 0.0],
    "length_m": 4.0,
    "radius_m": 0.11,
    "inner_radius_m": 0.1,
}


def decode_scene(**sections: Any) -> SceneFile:
    return decode_table(ConfigTable({**SCENE, **sections}, "terrain.toml"), SceneFile)


def find_height_m(scene: SceneFile, x: float, y: float) -> float:
    """Return the height of the highest block at a point; 0 on the ground."""
    blocks = [placed.obstacle for placed in place_scene_obstacles(scene)]
    distances_m = ObstacleOutlines.from_obstacles(blocks).compute_distances_m(np.array([x, y]))
    tops_m = [
        block.height_m
        for block, distance_m in zip(blocks, distances_m, strict=True)
        if distance_m < 0
    ]
    return max(tops_m, default=0.0)


def check_start(scene: SceneFile, y: float, radius_m: float = 0.04) -> None:
    """Check the clearance of a link that starts along x at this y."""
    link = CapsuleOutline(name="link_0", rear_m=(-0.1, y), front_m=(0.1, y), radius_m=radius_m)
    validate_start_clearance(scene, place_scene_obstacles(scene), [link])


@pytest.mark.parametrize("yaw_rad", [0.0, math.pi / 2, -2.0])
def test_stairs_rise_step_by_step_to_the_landing(yaw_rad: float) -> None:
    scene = decode_scene(stairs=[{**STAIRS, "yaw_rad": yaw_rad, "landing_m": 1.0, "friction": 0.7}])
    placed = place_scene_obstacles(scene)
    assert [item.obstacle.name for item in placed] == ["stairs_0_0", "stairs_0_1", "stairs_0_2"]
    assert all(item.walkable and item.friction == 0.7 for item in placed)
    along_m = (-0.05, 0.05, 0.25, 0.35, 0.55, 0.65, 1.55, 1.65)
    heights_m = [
        find_height_m(scene, 1.0 + along * math.cos(yaw_rad), 2.0 + along * math.sin(yaw_rad))
        for along in along_m
    ]
    assert heights_m == pytest.approx([0.0, 0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.0])


def test_gaps_are_between_platforms_of_equal_height() -> None:
    scene = decode_scene(gaps=[{**GAPS, "name": "row", "forward_friction": 0.1}])
    placed = place_scene_obstacles(scene)
    assert [item.obstacle.name for item in placed] == ["row_0", "row_1", "row_2"]
    assert all(item.walkable and item.forward_friction == 0.1 for item in placed)
    heights_m = [
        find_height_m(scene, x, 0.9)
        for x in (-0.49, 0.49, 0.51, 0.74, 0.76, 1.74, 1.76, 1.99, 2.01)
    ]
    assert heights_m == pytest.approx([0.2, 0.2, 0.0, 0.0, 0.2, 0.2, 0.0, 0.0, 0.2])


def test_stairs_that_are_too_high_are_refused() -> None:
    with raises_error(ConfigError, code="scene/invalid"):
        place_scene_obstacles(decode_scene(stairs=[{**STAIRS, "count": 21}]))


def test_names_of_pipes_and_obstacles_are_unique() -> None:
    peg = {"position_m": [0.0, 2.0], "radius_m": 0.1, "name": "pipe_0"}
    with raises_error(ConfigError, code="config/duplicate-name"):
        place_scene_obstacles(decode_scene(pipe=[PIPE], cylinder=[peg]))


def test_blocks_of_stairs_and_gaps_count_as_obstacles() -> None:
    many = [{**GAPS, "position_m": [0.0, 3.0 * i], "count": 199} for i in range(21)]
    with raises_error(ConfigError, code="scene/invalid"):
        place_scene_obstacles(decode_scene(gaps=many))


def test_outline_of_a_pipe_has_its_length_and_diameter() -> None:
    (outline,) = outline_pipes(decode_scene(pipe=[{**PIPE, "yaw_rad": 0.3}]))
    assert outline.obstacle.half_size_m == pytest.approx((2.0, 0.11, 0.11))
    assert outline.obstacle.yaw_rad == 0.3
    (half,) = outline_pipes(decode_scene(pipe=[{**PIPE, "open_top": True}]))
    assert half.obstacle.height_m == pytest.approx(0.11)


@pytest.mark.parametrize(
    "change",
    [
        {"inner_radius_m": 0.11},
        {"axis_height_m": 0.09},
        {"inner_radius_m": None, "open_top": True},
        {"inner_radius_m": None, "length_m": 0.2},
    ],
)
def test_pipe_that_cannot_be_built_is_refused(change: dict[str, Any]) -> None:
    with raises_error(ConfigError, code="scene/invalid"):
        check_start(decode_scene(pipe=[{**PIPE, **change}]), 0.0)


@pytest.mark.parametrize(
    ("y", "is_refused"), [(0.0, False), (0.055, False), (0.065, True), (0.14, True), (0.16, False)]
)
def test_snake_in_the_wall_of_a_pipe_is_refused(y: float, is_refused: bool) -> None:
    scene = decode_scene(pipe=[PIPE])
    if not is_refused:
        check_start(scene, y)
        return
    with raises_error(ConfigError, code="scene/overlap"):
        check_start(scene, y)


def test_snake_thicker_than_the_pipe_is_refused() -> None:
    with raises_error(ConfigError, code="scene/overlap"):
        check_start(decode_scene(pipe=[PIPE]), 0.0, radius_m=0.12)


def test_snake_starts_on_a_solid_pipe() -> None:
    check_start(decode_scene(pipe=[{**PIPE, "inner_radius_m": None}]), 0.0)


@pytest.mark.parametrize(
    "sections",
    [
        {"stairs": [{**STAIRS, "rise_m": 0}]},
        {"stairs": [{**STAIRS, "count": 0}]},
        {"gaps": [{**GAPS, "depth_m": 2.1}]},
        {"gaps": [{**GAPS, "gap_m": 0}]},
        {"pipe": [{**PIPE, "radius_m": 0}]},
    ],
)
def test_terrain_value_out_of_range_is_refused(sections: dict[str, Any]) -> None:
    with raises_error(ConfigError, code="config/out-of-range"):
        decode_scene(**sections)
