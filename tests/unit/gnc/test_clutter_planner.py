"""The planner through clutter: what it plans is free, pushes, is the same again, and changes when it must."""

import time
from functools import cache

import numpy as np
import pytest

from snakesim_gnc.geometry.body_on_path import compute_chain_points
from snakesim_gnc.navigation.clutter import NODES_PER_S, ClutterPlanner
from snakesim_gnc.navigation.intents import DesiredMotion
from snakesim_gnc.navigation.obstacle_grid import MAX_DISTANCE_M, NO_OBSTACLE, ObstacleGrid
from snakesim_gnc.navigation.path_search.beam import BeamSearch, PathSearchSteps
from snakesim_gnc.navigation.path_search.search_parameters import SearchParameters
from snakesim_gnc.navigation.path_search.search_task import SearchedPath
from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_hal.model.geometry.route import Route, compute_yaw_segments_m
from snakesim_hal.model.scenario import (
    HeadingGoal,
    WaypointGoal,
    compute_start_pose,
    load_scenario,
    parse_set_option,
    place_obstacles,
)
from snakesim_hal.wire.messages import KnownObstacle, Trajectory, WorldModel
from snakesim_testing.gnc.stage import make_world

TURN_S = 0.08  # a plan takes some of them
SECOND = 10**9
SEARCH = SearchParameters(body_length_m=1.54, radius_m=0.04, segment_m=0.11)


@cache
def field(density: float = 8.0) -> tuple[list[KnownObstacle], np.ndarray]:
    """Obstacles, and the nodes of the body where it is laid down."""
    flags = ("scene.random_field.0.seed=1", f"scene.random_field.0.density_per_m2={density}")
    config = load_scenario("surveyed_clutter", [parse_set_option(flag) for flag in flags]).config
    start, segments = (
        compute_start_pose(config),
        compute_yaw_segments_m(config.robot.axes, config.robot.link_lengths_m),
    )
    body = compute_chain_points(
        start.position_w, start.yaw_rad, start.angles_rad.tolist(), segments
    ).T
    return [placed.obstacle for placed in place_obstacles(config)], body


def world(at_s: float, obstacles: list[KnownObstacle]) -> WorldModel:
    return make_world(
        tick=round(100 * at_s), timestamp_ns=round(at_s * SECOND), obstacles=obstacles
    )


def planner(
    known: list[KnownObstacle] | None, goal: HeadingGoal | WaypointGoal | None = None
) -> ClutterPlanner:
    return ClutterPlanner(
        goal or HeadingGoal(), known, search_parameters=SEARCH, update_period_s=TURN_S
    )


def planned(
    made: ClutterPlanner,
    body: np.ndarray,
    at_s: float = 0.0,
    seen: list[KnownObstacle] | None = None,
    heading_rad: float | None = None,
) -> Trajectory:
    """The trajectory of a turn and, without the body or time going on, of those until it is no longer searched."""
    desired = DesiredMotion(0.2, heading_w_rad=heading_rad)
    tick = round(100 * at_s)
    found = made.update(tick, world(at_s, seen or []), body, desired)
    while found.searching:
        tick += 1
        found = made.update(tick, world(at_s, seen or []), body, desired)
    return found


def path_of(search: PathSearchSteps) -> SearchedPath | None:
    while True:
        try:
            next(search)
        except StopIteration as done:
            return done.value


def test_the_map_knows_the_nearest_obstacle_and_its_distance() -> None:
    obstacles, _ = field()
    made, random = ObstacleGrid(obstacles), np.random.default_rng(0)
    points = random.uniform((0.0, -1.2), (6.5, 1.2), (300, 2))
    near = made.find_nearest(points[:, 0], points[:, 1])
    for k, point in enumerate(points):
        least = min(compute_outline_distance_m(o, point) for o in obstacles)
        assert near.distance_m[k] == pytest.approx(min(least, MAX_DISTANCE_M), abs=0.011)
        if near.obstacle_index[k] != NO_OBSTACLE and near.distance_m[k] > 1e-6:
            assert np.hypot(*near.normal_w[k]) == pytest.approx(1.0)
            moved = point + 1e-4 * near.normal_w[k]
            grown = (
                compute_outline_distance_m(obstacles[near.obstacle_index[k]], moved)
                - near.distance_m[k]
            )
            assert grown == pytest.approx(1e-4, rel=1e-3)


@pytest.mark.parametrize("density", [12.0, pytest.param(8.0, marks=pytest.mark.slow)])
def test_planner_path_avoids_obstacles_and_allows_pushing(density: float) -> None:
    obstacles, body = field(density)
    made = ObstacleGrid(obstacles)
    found = path_of(BeamSearch(made, SEARCH).search_ahead(body, 0.0, 60))
    assert found is not None
    assert len(found.points_w) == 61
    near = made.find_nearest(found.points_w[1:, 0], found.points_w[1:, 1])
    assert near.distance_m.min() >= SEARCH.radius_m + SEARCH.clearance_m
    assert found.points_w[-1, 0] - found.points_w[0, 0] > 2.0
    assert np.median(found.margins_n) > 20.0
    smooth = planned(planner(obstacles), body)
    points = np.array(smooth.path_w)
    assert (
        made.find_nearest(points[:, 0], points[:, 1]).distance_m.min() > SEARCH.radius_m - 0.012
    )  # pressed, not through
    assert points[0] == pytest.approx(body[0], abs=0.01)


def test_planner_body_standing_still_gets_new_path_then_backs_out() -> None:
    obstacles, body = field()
    made = planner(obstacles)
    seen = [planned(made, body, at_s) for at_s in np.arange(0.0, 6.0, 0.2).tolist()]
    assert len({one.path_id for one in seen}) >= 3
    assert any(one.speed_m_s < 0 for one in seen)
    assert seen[0].speed_m_s == 0.2


@pytest.mark.slow
def test_planner_displaced_body_gets_path_from_where_it_lies() -> None:
    obstacles, body = field()
    made = planner(obstacles)
    stood = [planned(made, body, at_s) for at_s in np.arange(0.0, 1.2, 0.2).tolist()][-1]
    moved = body + np.array([0.0, 0.05])
    again = planned(made, moved, 2.5)
    assert again.path_id > stood.path_id
    assert np.hypot(*(np.array(again.path_w) - moved[-1]).T).min() < 0.02


def test_only_what_is_seen_is_planned_around() -> None:
    _, body = field()
    made = planner(None)
    blind = planned(made, body)
    wall = KnownObstacle(
        name="wall",
        shape="box",
        position_w=(2.2, 0.0, 0.1),
        half_size_m=(0.05, 0.4, 0.1),
        height_m=0.2,
    )
    points = np.array(blind.path_w)
    assert min(compute_outline_distance_m(wall, p) for p in points) < 0.0  # it does not know yet
    seen = planned(made, body, 0.2, [wall])
    assert seen.path_id != blind.path_id
    assert min(compute_outline_distance_m(wall, p) for p in np.array(seen.path_w)) > 0.03


@pytest.mark.slow  # whole runs through clutter reach it in tests/system/physics
def test_a_goal_is_reached() -> None:
    obstacles, body = field()
    made = planner(obstacles, HeadingGoal(distance_m=0.5))
    assert not planned(made, body).finished
    there = planned(made, body + np.array([0.6, 0.0]), 1.0)
    assert there.finished
    assert there.speed_m_s == 0.0
    assert there.reason == "the goal is reached"
    assert planned(made, body + np.array([0.495, 0.0]), 2.0).finished  # noise
    # It was measured wrong, or slid back.
    assert not planned(made, body + np.array([0.45, 0.0]), 3.0).finished
    head = body[-1]
    points = [(float(head[0]) + 0.1, float(head[1])), (float(head[0]) + 1.0, float(head[1]))]
    made = planner(obstacles, WaypointGoal(points_m=points, within_m=0.2))
    assert not planned(made, body).finished
    assert planned(made, body + np.array([0.95, 0.0]), 1.0).finished


@pytest.mark.parametrize(
    "heading_rad", [0.7, *(pytest.param(at, marks=pytest.mark.slow) for at in (-0.7, 3.0))]
)
def test_planner_requested_heading_overrides_mission(heading_rad: float) -> None:
    obstacles, body = field()
    made = planner(obstacles, HeadingGoal(distance_m=0.1))
    ahead = planned(made, body)
    moved = body + np.array([0.3, 0.0])
    turned = planned(made, moved, 0.2, heading_rad=heading_rad)
    assert turned.path_id != ahead.path_id
    assert not turned.finished
    way = np.array(turned.path_w[-1]) - moved[-1]
    reached = np.clip(heading_rad, -1.2, 1.2)  # one path turns the head by no more
    assert np.arctan2(way[1], way[0]) == pytest.approx(reached, abs=0.45)  # as obstacles let it
    assert planned(made, moved, 0.4, heading_rad=heading_rad + 0.1).path_id == turned.path_id
    assert planned(made, moved, 0.6).finished  # the mission again


def turns(
    made: ClutterPlanner, body: np.ndarray, count: int, heading_rad: float | None = None
) -> list[Trajectory]:
    """Turns of 0.2 s, in which the body stays where it is."""
    desired = DesiredMotion(0.2, heading_w_rad=heading_rad)
    return [made.update(20 * k, world(0.01 * k, []), body, desired) for k in range(count)]


def test_planner_follows_old_path_while_work_per_turn_is_bounded() -> None:
    obstacles, body = field()
    made = planner(obstacles)
    route = Route(np.concatenate([body, body[-1] + np.array([[1.0, 0.0], [5.0, 0.0]])]))
    made.follow_route(route, ["peg"])
    seen = turns(made, body, 6, heading_rad=0.7)
    waiting = [one for one in seen if one.searching]
    assert 1 <= len(waiting) <= 4
    assert all(one.searched_nodes <= TURN_S * NODES_PER_S for one in seen)
    for one in waiting:
        assert one.searching == "the direction has changed"
        assert one.searched_nodes > 0.5 * TURN_S * NODES_PER_S
        assert one.path_id == 0
        assert one.speed_m_s == 0.2
        assert one.push_points == ["peg"]
        assert np.array_equal(one.path_w, route.points_w)
    after = seen[len(waiting) :]
    assert {one.path_id for one in after} == {1}
    assert after[1].searched_nodes == 0
    begin = np.array(after[0].path_w)
    ahead = route.compute_positions_w(route.length_m - 6.0 + np.arange(0.02, 0.1, 0.02))
    # It begins with the path before.
    assert max(np.hypot(*(begin - point).T).min() for point in ahead) < 0.01


def test_a_plan_is_the_same_in_however_many_slices() -> None:
    obstacles, body = field()
    made = [
        ClutterPlanner(HeadingGoal(), obstacles, search_parameters=SEARCH, update_period_s=turn_s)
        for turn_s in (0.08, 0.5)
    ]
    few, many = (turns(one, body, 40)[-1] for one in made)
    assert few.path_id == 1
    assert few.path_w == many.path_w


def test_nothing_moves_before_the_first_path_is_there() -> None:
    obstacles, body = field()
    made = planner(obstacles)
    first = turns(made, body, 1)[0]
    assert not made.has_plan
    assert first.speed_m_s == 0.0
    assert first.searching == "the first path"
    assert first.reason == "the first path: a path is being searched"
    moving = turns(made, body, 30)[-1]
    assert made.has_plan
    assert moving.speed_m_s == 0.2
    assert moving.searching == ""
    assert moving.reason == ""


def test_a_tick_that_is_shown_again_is_one_turn() -> None:
    obstacles, body = field()
    made, desired = planner(None), DesiredMotion(0.2)
    assert planned(made, body).path_id == 1
    shown = [made.update(400, world(4.0, obstacles), body, desired) for _ in range(20)]
    assert shown[0].searching == "the map has changed"
    assert shown[-1] == shown[0]


@pytest.mark.parametrize(
    ("seen", "turn_s"),
    [
        (False, 0.2),
        *(
            pytest.param(*row, marks=pytest.mark.slow)
            for row in ((True, 0.2), (False, 0.02), (True, 0.02))
        ),
    ],
)
def test_the_work_of_a_turn_is_bounded_whatever_is_planned(seen: bool, turn_s: float) -> None:
    """Counted, and in CPU time: ten times what the rate allows, so that a slow computer passes."""
    obstacles, body = field(density=12.0)
    made = ClutterPlanner(
        HeadingGoal(), None if seen else obstacles, search_parameters=SEARCH, update_period_s=turn_s
    )
    done, paths, took_s = [], set(), []
    for k in range(
        round(12.0 / turn_s)
    ):  # it stands: stuck paths, backing out, and a turn to the left
        desired = DesiredMotion(0.2, heading_w_rad=None if k * turn_s < 8.0 else 0.7)
        began = time.thread_time()
        found = made.update(k, world(k * turn_s, obstacles), body, desired)
        took_s.append(time.thread_time() - began)
        done.append(found.searched_nodes)
        paths.add(found.path_id)
    assert len(paths) > 3
    largest_step = 8000  # the fit of the longest path
    assert max(done) <= max(NODES_PER_S * turn_s, largest_step)
    assert all(sum(done[: k + 1]) <= NODES_PER_S * turn_s * (k + 1) for k in range(len(done)))
    assert max(took_s) < 10 * max(turn_s, largest_step / NODES_PER_S)
