"""Obstacles of a scene are placed by its rules, and invalid scenes are refused."""

import itertools
import math
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.geometry.outlines import (
    CapsuleOutline,
    ObstacleOutlines,
    compute_outline_distance_m,
)
from snakesim_hal.model.scene_file.placement import (
    PlacedObstacle,
    place_scene_obstacles,
    validate_start_clearance,
)
from snakesim_hal.model.scene_file.scene import SceneFile, make_route
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_testing.hal.small_robots import SCENE
from snakesim_testing.hypothesis_profiles import choose_trial_count
from snakesim_testing.messages import raises_error

SINE_ROUTE = {"kind": "sine", "amplitude_m": 0.1, "wavelength_m": 0.8, "length_m": 4.0}
RANDOM_FIELD: dict[str, Any] = {
    "seed": 7,
    "min_corner_m": [0.0, -1.0],
    "max_corner_m": [2.0, 1.0],
    "density_per_m2": 5.0,
    "radius_m": [0.02, 0.05],
    "clearance_m": 0.05,
}
SNAKE = [
    CapsuleOutline(
        name=f"link_{i}", rear_m=(0.2 * i, 0.0), front_m=(0.2 * i + 0.2, 0.0), radius_m=0.04
    )
    for i in range(3)
]
LINKS = ObstacleOutlines.from_segments(
    np.array([link.rear_m for link in SNAKE]), np.array([link.front_m for link in SNAKE]), 0.04
)


def make_scene(**sections: Any) -> SceneFile:
    """Return a scene with these sections."""
    return decode_table(ConfigTable({**SCENE, **sections}, "bend.toml"), SceneFile)


def check_refused_if(overlaps: bool, tested_scene: SceneFile, name: str) -> None:
    """Check that a scene is refused if and only if the named obstacle overlaps the snake."""
    with raises_error(ConfigError, code="scene/overlap", field=name) if overlaps else nullcontext():
        validate_start_clearance(tested_scene, place_scene_obstacles(tested_scene), SNAKE)


def place_one(**sections: Any) -> PlacedObstacle:
    """Return the only obstacle of a scene with these sections."""
    (placed,) = place_scene_obstacles(make_scene(**sections))
    return placed


def test_scene_cylinder_stands_on_ground_with_its_name_and_friction() -> None:
    placed = place_one(
        cylinder=[
            {
                "position_m": [1, 2],
                "radius_m": 0.1,
                "height_m": 0.4,
                "friction": 0.3,
                "name": "post",
            }
        ]
    )
    center_height_m = 0.4 / 2
    assert placed == PlacedObstacle(
        obstacle=KnownObstacle(
            name="post",
            shape="cylinder",
            position_w=(1, 2, center_height_m),
            radius_m=0.1,
            height_m=0.4,
        ),
        friction=0.3,
    )


def test_scene_box_without_name_is_numbered_and_stands_on_ground() -> None:
    obstacle = place_one(
        box=[{"position_m": [3, 0], "size_m": [0.4, 0.2, 0.6], "yaw_rad": 0.5}]
    ).obstacle
    assert obstacle.name == "box_0"
    assert obstacle.half_size_m == pytest.approx((0.2, 0.1, 0.3))
    assert obstacle.position_w[2] == 0.6 / 2
    assert obstacle.yaw_rad == 0.5


def test_scene_sphere_is_at_its_center_height() -> None:
    obstacle = place_one(
        sphere=[{"position_m": [0, 3], "radius_m": 0.2, "center_height_m": 0.05}]
    ).obstacle
    assert obstacle.position_w == (0, 3, 0.05)
    assert obstacle.radius_m == 0.2


def test_scene_wall_is_box_from_end_to_end() -> None:
    obstacle = place_one(
        wall=[{"from_m": [0, 5], "to_m": [3, 9], "thickness_m": 0.1, "height_m": 0.5}]  # 5 m long
    ).obstacle
    assert obstacle.position_w == pytest.approx((1.5, 7, 0.25))
    assert obstacle.half_size_m == pytest.approx((2.5, 0.05, 0.25))
    assert obstacle.yaw_rad == pytest.approx(math.atan2(4, 3))


def test_scene_step_alone_is_walkable() -> None:
    step = place_one(step=[{"position_m": [0, -4], "size_m": [1.0, 0.5], "height_m": 0.03}])
    wall = place_one(wall=[{"from_m": [0, 5], "to_m": [3, 9], "thickness_m": 0.1, "height_m": 0.5}])
    assert step.walkable
    assert not wall.walkable


def test_scene_row_material_applies_to_all_and_keeps_places() -> None:
    material = {"friction": 0.1, "mass_kg": 2.0, "base_friction": 0.5}
    row = {"corridor_m": 0.06, "radius_m": 0.05, "count": 3}
    fixed_items = place_scene_obstacles(
        make_scene(route=SINE_ROUTE, pegs_along_route=[row], random_field=[RANDOM_FIELD])
    )
    leaning_field = {**RANDOM_FIELD, **material, "lean_up_to_rad": 0.2}
    movable_items = place_scene_obstacles(
        make_scene(
            route=SINE_ROUTE,
            pegs_along_route=[{**row, **material, "lean_rad": 0.3}],
            random_field=[leaning_field],
        )
    )
    assert [item.obstacle for item in movable_items] == [item.obstacle for item in fixed_items]
    assert {(item.friction, item.compute_sliding_force_n()) for item in fixed_items} == {
        (0.2, None)
    }
    assert {(item.friction, item.compute_sliding_force_n()) for item in movable_items} == {
        (0.1, 0.5 * 9.81 * 2.0)
    }
    assert not any(item.can_move for item in fixed_items)
    assert all(item.can_move for item in movable_items)
    assert [item.lean_rad for item in movable_items[:3]] == [0.3] * 3
    leans = np.array([(item.lean_rad, item.lean_towards_rad) for item in movable_items[3:]])
    assert len(set(leans[:, 0])) == len(leans)
    assert leans[:, 0].min() >= 0.0
    assert leans[:, 0].max() <= 0.2
    assert leans[:, 1].min() < -1.0
    assert leans[:, 1].max() > 1.0


def test_scene_leaning_peg_that_overlaps_snake_start_is_refused() -> None:
    peg = {"position_m": [0.3, 0.095], "radius_m": 0.05}
    for towards_rad, overlaps in ((-math.pi / 2, True), (math.pi / 2, False)):
        leaning_scene = make_scene(
            cylinder=[{**peg, "lean_rad": 0.4, "lean_towards_rad": towards_rad}]
        )
        check_refused_if(overlaps, leaning_scene, "cylinder_0")


# --- pegs along the route --------------------------------------------------------------------------------------


@given(
    corridor_m=st.floats(0.03, 0.1),
    radius_m=st.floats(0.02, 0.08),
    count=st.integers(1, 7),
    first=st.integers(0, 2),
    amplitude_m=st.floats(0.02, 0.12),
)
def test_scene_pegs_along_route_are_on_the_pushing_side(
    corridor_m: float, radius_m: float, count: int, first: int, amplitude_m: float
) -> None:
    row = {"corridor_m": corridor_m, "radius_m": radius_m, "count": count, "first": first}
    tested_scene = make_scene(
        route={**SINE_ROUTE, "amplitude_m": amplitude_m}, pegs_along_route=[row]
    )
    route = make_route(tested_scene)
    assert route is not None
    pegs = [item.obstacle for item in place_scene_obstacles(tested_scene)]
    assert [peg.name for peg in pegs] == [f"peg_0_{first + index}" for index in range(count)]
    inflections_s_m = route.find_inflections_s_m()[first:]
    for index, peg in enumerate(pegs):
        center = np.array(peg.position_w[:2])
        route_point = route.compute_positions_w(inflections_s_m[index])
        push = (route_point - center) / np.linalg.norm(route_point - center)  # from peg to body
        assert np.linalg.norm(route_point - center) - radius_m == pytest.approx(corridor_m)
        assert push @ route.tangent_w(inflections_s_m[index]) == pytest.approx(0.0, abs=1e-6)
        assert push[0] > 0  # the route runs along x
    sides = [
        math.copysign(1, peg.position_w[1] - route.compute_point(s_m)[1])
        for peg, s_m in zip(pegs, inflections_s_m, strict=False)
    ]
    assert all(side == -next_side for side, next_side in itertools.pairwise(sides))


def test_scene_too_many_pegs_or_without_route_are_refused() -> None:
    row = {"corridor_m": 0.05, "radius_m": 0.05}
    with raises_error(
        ConfigError, code="scene/invalid", field=("pegs_along_route.0", "count"), value=12
    ):
        place_scene_obstacles(
            make_scene(route=SINE_ROUTE, pegs_along_route=[{**row, "count": 12, "first": 1}])
        )
    with raises_error(ConfigError, code="scene/no-route", field="pegs_along_route.0"):
        place_scene_obstacles(make_scene(pegs_along_route=[{**row, "count": 1}]))
    with raises_error(ConfigError, code="scene/invalid"):
        place_scene_obstacles(
            make_scene(route=SINE_ROUTE, pegs_along_route=[{**row, "count": 1, "first": 50}])
        )


# --- random fields ---------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**31), clearance_m=st.floats(0, 0.1), route_clearance_m=st.floats(0, 0.1)
)
@settings(max_examples=choose_trial_count(20))
def test_scene_random_field_keeps_its_clearances(
    seed: int, clearance_m: float, route_clearance_m: float
) -> None:
    field = {
        **RANDOM_FIELD,
        "seed": seed,
        "clearance_m": clearance_m,
        "route_clearance_m": route_clearance_m,
    }
    post = {"position_m": [1.0, 0.5], "radius_m": 0.1, "name": "post"}
    tested_scene = make_scene(route=SINE_ROUTE, cylinder=[post], random_field=[field])
    route = make_route(tested_scene)
    assert route is not None
    pegs = [item.obstacle for item in place_scene_obstacles(tested_scene, SNAKE)]
    placed = pegs[1:]
    assert len(placed) == round(5.0 * 4.0)
    for i, peg in enumerate(placed):
        center = np.array(peg.position_w[:2])
        assert 0.02 <= peg.radius_m <= 0.05
        assert -1e-9 <= center[0] <= 2
        assert -1 <= center[1] <= 1
        for other in [pegs[0], *placed[:i]]:
            assert compute_outline_distance_m(other, center) - peg.radius_m >= clearance_m - 1e-9
        assert LINKS.compute_distances_m(center).min() - peg.radius_m >= clearance_m - 1e-9
        route_points_w = route.compute_positions_w(np.linspace(0, route.length_m, 2000))
        assert (
            np.hypot(*(route_points_w - center).T).min() - peg.radius_m >= route_clearance_m - 1e-5
        )


@pytest.mark.slow  # another test checks the overlap of each block with the snake
@given(seed=st.integers(0, 2**31))
@settings(max_examples=4)
def test_scene_random_blocks_keep_their_clearances(seed: int) -> None:
    field = {
        **RANDOM_FIELD,
        "seed": seed,
        "density_per_m2": 8.0,
        "box_fraction": 0.6,
        "clearance_m": 0.1,
    }
    placed = [
        item.obstacle for item in place_scene_obstacles(make_scene(random_field=[field]), SNAKE)
    ]
    assert {obstacle.shape for obstacle in placed} == {"cylinder", "box"}
    steps = np.linspace(-1.0, 1.0, 41)
    square = np.concatenate([[(x, y), (y, x)] for x in steps for y in (-1.0, 1.0)])
    for block in placed:
        cosine = np.cos(block.yaw_rad)
        sine = np.sin(block.yaw_rad)
        if block.shape == "cylinder":
            rim = block.radius_m * np.column_stack([np.cos(steps * np.pi), np.sin(steps * np.pi)])
        else:
            rim = square * block.half_size_m[:2] @ np.array([[cosine, sine], [-sine, cosine]])
            assert all(0.06 <= 2 * half <= 0.18 for half in block.half_size_m[:2])
        for point in np.array(block.position_w[:2]) + rim:
            assert (
                min(
                    (
                        compute_outline_distance_m(other, point)
                        for other in placed
                        if other is not block
                    ),
                    default=1.0,
                )
                >= 0.1 - 1e-9
            )
            assert LINKS.compute_distances_m(point).min() >= 0.1 - 1e-9


def test_scene_random_pegs_depend_only_on_their_seed() -> None:
    first, same_seed = (
        place_scene_obstacles(make_scene(random_field=[RANDOM_FIELD])) for _ in range(2)
    )
    assert first == same_seed
    assert place_scene_obstacles(make_scene(random_field=[{**RANDOM_FIELD, "seed": 8}])) != first
    two_fields = place_scene_obstacles(
        make_scene(
            random_field=[
                RANDOM_FIELD,
                {**RANDOM_FIELD, "min_corner_m": [3, -1], "max_corner_m": [5, 1]},
            ]
        )
    )
    assert two_fields[: len(first)] == first  # a second field does not change the first
    assert {peg.obstacle.name for peg in two_fields[len(first) :]} == {
        f"random_1_{number}" for number in range(20)
    }
    assert [item.obstacle.radius_m for item in two_fields[len(first) :]] != [
        item.obstacle.radius_m for item in first
    ]


# --- invalid scenes --------------------------------------------------------------------------------------------


def test_scene_two_obstacles_with_one_name_are_refused() -> None:
    post = {"position_m": [1, 2], "radius_m": 0.1, "name": "post"}
    with raises_error(ConfigError, code="config/duplicate-name", field="plain"):
        place_scene_obstacles(make_scene(cylinder=[post, {**post, "position_m": [2, 2]}]))
    with raises_error(ConfigError, code="config/duplicate-name", field="box_0"):
        place_scene_obstacles(
            make_scene(
                cylinder=[{**post, "name": "box_0"}],
                box=[{"position_m": [5, 5], "size_m": [1, 1, 1]}],
            )
        )


def test_scene_zero_length_wall_and_equal_route_points_are_refused() -> None:
    with raises_error(ConfigError, code="scene/invalid", field="wall.0"):
        place_scene_obstacles(make_scene(wall=[{"from_m": [1, 1], "to_m": [1, 1]}]))
    with raises_error(ConfigError, code="scene/invalid", field="route.points_m"):
        make_route(make_scene(route={"kind": "waypoints", "points_m": [[0, 0], [0, 0]]}))


# --- clearance to the start pose -------------------------------------------------------------------------------


@given(x=st.floats(-0.3, 0.9), y=st.floats(-0.3, 0.3), radius_m=st.floats(0.02, 0.1))
def test_scene_peg_is_refused_only_if_it_overlaps_snake(
    x: float, y: float, radius_m: float
) -> None:
    gap_m = math.dist((x, y), (min(max(x, 0.0), 0.6), 0.0)) - 0.04 - radius_m
    assume(abs(gap_m) > 2e-4)
    tested_scene = make_scene(
        cylinder=[{"position_m": [x, y], "radius_m": radius_m, "name": "post"}]
    )
    check_refused_if(gap_m < 0, tested_scene, "post")


@given(x=st.floats(-0.5, 1.1), y=st.floats(-0.5, 0.5), yaw_rad=st.floats(-3, 3))
def test_scene_block_is_refused_only_if_it_overlaps_snake(
    x: float, y: float, yaw_rad: float
) -> None:
    tested_scene = make_scene(
        box=[{"position_m": [x, y], "size_m": [0.3, 0.1, 0.2], "yaw_rad": yaw_rad}]
    )
    (block,) = place_scene_obstacles(tested_scene)
    centerline = np.column_stack([np.linspace(0, 0.6, 1200), np.zeros(1200)])
    gap_m = min(compute_outline_distance_m(block.obstacle, point) for point in centerline) - 0.04
    assume(abs(gap_m) > 2e-3)
    check_refused_if(gap_m < 0, tested_scene, "box_0")


def test_scene_step_under_the_snake_is_accepted() -> None:
    tested_scene = make_scene(step=[{"position_m": [0.3, 0], "size_m": [2, 1], "height_m": 0.02}])
    validate_start_clearance(tested_scene, place_scene_obstacles(tested_scene), SNAKE)


def test_outline_distance_of_cylinder_and_box_is_exact() -> None:
    peg = KnownObstacle(name="p", shape="cylinder", position_w=(1, 0, 0), radius_m=0.2)
    assert compute_outline_distance_m(peg, np.array([2.0, 0.0])) == pytest.approx(0.8)
    block = KnownObstacle(
        name="b", shape="box", position_w=(0, 0, 0), yaw_rad=math.pi / 2, half_size_m=(2, 1, 1)
    )
    assert compute_outline_distance_m(block, np.array([0.0, 3.0])) == pytest.approx(1.0)
    assert compute_outline_distance_m(block, np.array([4.0, 6.0])) == pytest.approx(5.0)
    assert compute_outline_distance_m(block, np.array([0.5, 0.0])) == pytest.approx(-0.5)
