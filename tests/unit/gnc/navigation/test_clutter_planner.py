"""Tests the planner of paths through clutter.

Its paths are free of obstacles, allow the body to push, and are repeatable. They change with the map, the mission,
and a displaced body, and the work of each update is bounded.
"""

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

UPDATE_PERIOD_S = 0.08  # one plan takes several updates
SECOND_NS = 10**9
SPEED_M_S = 0.2  # of the mission
MAX_TURN_RAD = 1.2  # by which one path turns the head
MAX_FIT_NODES = 8000  # that the fit of the longest path counts as, in one update
SEARCH = SearchParameters(body_length_m=1.54, radius_m=0.04, segment_m=0.11)


@cache
def make_random_scene(density_per_m2: float = 8.0) -> tuple[list[KnownObstacle], np.ndarray]:
    """Return obstacles, and the points (n, 2) of the body at its start, from tail to head."""
    options = (
        "scene.random_field.0.seed=1",
        f"scene.random_field.0.density_per_m2={density_per_m2}",
    )
    config = load_scenario(
        "surveyed_clutter", [parse_set_option(option) for option in options]
    ).config
    start = compute_start_pose(config)
    segments_m = compute_yaw_segments_m(config.robot.axes, config.robot.link_lengths_m)
    body_w = compute_chain_points(
        start.position_w, start.yaw_rad, start.angles_rad.tolist(), segments_m
    ).T
    return [placed.obstacle for placed in place_obstacles(config)], body_w


def make_world_at(time_s: float, obstacles: list[KnownObstacle]) -> WorldModel:
    return make_world(
        tick=round(100 * time_s), timestamp_ns=round(time_s * SECOND_NS), obstacles=obstacles
    )


def make_planner(
    known_obstacles: list[KnownObstacle] | None, goal: HeadingGoal | WaypointGoal | None = None
) -> ClutterPlanner:
    """Return a planner with a surveyed map, or one that plans around perceived obstacles."""
    return ClutterPlanner(
        goal or HeadingGoal(),
        known_obstacles,
        search_parameters=SEARCH,
        update_period_s=UPDATE_PERIOD_S,
    )


def plan_until_found(
    planner: ClutterPlanner,
    body_w: np.ndarray,
    time_s: float = 0.0,
    perceived: list[KnownObstacle] | None = None,
    heading_rad: float | None = None,
) -> Trajectory:
    """Update the planner until it searches no path, while time and body stand still."""
    desired = DesiredMotion(SPEED_M_S, heading_w_rad=heading_rad)
    world = make_world_at(time_s, perceived or [])
    tick = round(100 * time_s)
    trajectory = planner.update(tick, world, body_w, desired)
    while trajectory.searching:
        tick += 1
        trajectory = planner.update(tick, world, body_w, desired)
    return trajectory


def finish_search(search: PathSearchSteps) -> SearchedPath | None:
    """Make all steps of a search, and return its path."""
    while True:
        try:
            next(search)
        except StopIteration as done:
            return done.value


def measure_clearance_m(obstacle: KnownObstacle, points_w: np.ndarray) -> float:
    """Return the distance of an obstacle from the nearest point, negative inside."""
    return min(compute_outline_distance_m(obstacle, point) for point in points_w)


def test_obstacle_grid_finds_the_nearest_obstacle_and_its_distance() -> None:
    obstacles, _ = make_random_scene()
    grid = ObstacleGrid(obstacles)
    random = np.random.default_rng(0)
    points_w = random.uniform((0.0, -1.2), (6.5, 1.2), (300, 2))
    near = grid.find_nearest(points_w[:, 0], points_w[:, 1])
    for k, point_w in enumerate(points_w):
        distance_m = min(compute_outline_distance_m(obstacle, point_w) for obstacle in obstacles)
        assert near.distance_m[k] == pytest.approx(min(distance_m, MAX_DISTANCE_M), abs=0.011)
        if near.obstacle_index[k] != NO_OBSTACLE and near.distance_m[k] > 1e-6:
            assert np.hypot(*near.normal_w[k]) == pytest.approx(1.0)
            # A small step along the normal increases the distance by its length.
            nearest = obstacles[near.obstacle_index[k]]
            moved_w = point_w + 1e-4 * near.normal_w[k]
            added_m = compute_outline_distance_m(nearest, moved_w) - near.distance_m[k]
            assert added_m == pytest.approx(1e-4, rel=1e-3)


@pytest.mark.parametrize("density", [12.0, pytest.param(8.0, marks=pytest.mark.slow)])
def test_planner_path_avoids_obstacles_and_allows_pushing(density: float) -> None:
    obstacles, body_w = make_random_scene(density)
    grid = ObstacleGrid(obstacles)
    searched = finish_search(BeamSearch(grid, SEARCH).search_ahead(body_w, 0.0, 60))
    assert searched is not None
    assert len(searched.points_w) == 61
    near = grid.find_nearest(searched.points_w[1:, 0], searched.points_w[1:, 1])
    assert near.distance_m.min() >= SEARCH.radius_m + SEARCH.clearance_m
    assert searched.points_w[-1, 0] - searched.points_w[0, 0] > 2.0
    assert np.median(searched.margins_n) > 20.0

    # The smoothed path may press the body against obstacles, and does not lead through them.
    smoothed_w = np.array(plan_until_found(make_planner(obstacles), body_w).path_w)
    near = grid.find_nearest(smoothed_w[:, 0], smoothed_w[:, 1])
    assert near.distance_m.min() > SEARCH.radius_m - 0.012
    assert smoothed_w[0] == pytest.approx(body_w[0], abs=0.01)


def test_planner_body_standing_still_gets_new_path_then_backs_out() -> None:
    obstacles, body_w = make_random_scene()
    planner = make_planner(obstacles)
    times_s = np.arange(0.0, 6.0, 0.2).tolist()
    trajectories = [plan_until_found(planner, body_w, time_s) for time_s in times_s]
    assert len({trajectory.path_id for trajectory in trajectories}) >= 3
    assert any(trajectory.speed_m_s < 0 for trajectory in trajectories)
    assert trajectories[0].speed_m_s == SPEED_M_S


@pytest.mark.slow
def test_planner_displaced_body_gets_path_from_its_position() -> None:
    obstacles, body_w = make_random_scene()
    planner = make_planner(obstacles)
    times_s = np.arange(0.0, 1.2, 0.2).tolist()
    before = [plan_until_found(planner, body_w, time_s) for time_s in times_s][-1]
    displaced_w = body_w + np.array([0.0, 0.05])
    after = plan_until_found(planner, displaced_w, 2.5)
    assert after.path_id > before.path_id
    assert np.hypot(*(np.array(after.path_w) - displaced_w[-1]).T).min() < 0.02


def test_planner_avoids_a_wall_once_it_is_perceived() -> None:
    _, body_w = make_random_scene()
    planner = make_planner(None)
    before = plan_until_found(planner, body_w)
    wall = KnownObstacle(
        name="wall",
        shape="box",
        position_w=(2.2, 0.0, 0.1),
        half_size_m=(0.05, 0.4, 0.1),
        height_m=0.2,
    )
    assert measure_clearance_m(wall, np.array(before.path_w)) < 0.0
    after = plan_until_found(planner, body_w, 0.2, [wall])
    assert after.path_id != before.path_id
    assert measure_clearance_m(wall, np.array(after.path_w)) > 0.03


@pytest.mark.slow  # whole runs through clutter reach it in tests/system/physics
def test_planner_at_its_goal_is_finished_and_stops() -> None:
    obstacles, body_w = make_random_scene()
    planner = make_planner(obstacles, HeadingGoal(distance_m=0.5))
    assert not plan_until_found(planner, body_w).finished
    reached = plan_until_found(planner, body_w + np.array([0.6, 0.0]), 1.0)
    assert reached.finished
    assert reached.speed_m_s == 0.0
    assert reached.reason == "the goal is reached"
    # Noise of the pose does not revoke the goal; a body that slid back does.
    assert plan_until_found(planner, body_w + np.array([0.495, 0.0]), 2.0).finished
    assert not plan_until_found(planner, body_w + np.array([0.45, 0.0]), 3.0).finished

    head_x_m, head_y_m = body_w[-1].tolist()
    waypoints_m = [(head_x_m + 0.1, head_y_m), (head_x_m + 1.0, head_y_m)]
    planner = make_planner(obstacles, WaypointGoal(points_m=waypoints_m, within_m=0.2))
    assert not plan_until_found(planner, body_w).finished
    assert plan_until_found(planner, body_w + np.array([0.95, 0.0]), 1.0).finished


@pytest.mark.parametrize(
    "heading_rad",
    [0.7, *(pytest.param(heading, marks=pytest.mark.slow) for heading in (-0.7, 3.0))],
)
def test_planner_requested_heading_overrides_mission(heading_rad: float) -> None:
    obstacles, body_w = make_random_scene()
    planner = make_planner(obstacles, HeadingGoal(distance_m=0.1))
    ahead = plan_until_found(planner, body_w)
    moved_w = body_w + np.array([0.3, 0.0])
    turned = plan_until_found(planner, moved_w, 0.2, heading_rad=heading_rad)
    assert turned.path_id != ahead.path_id
    assert not turned.finished
    way_w = np.array(turned.path_w[-1]) - moved_w[-1]
    expected_rad = np.clip(heading_rad, -MAX_TURN_RAD, MAX_TURN_RAD)
    assert np.arctan2(way_w[1], way_w[0]) == pytest.approx(expected_rad, abs=0.45)

    # A small change of the heading keeps the path. Without a request, the mission counts again.
    similar = plan_until_found(planner, moved_w, 0.4, heading_rad=heading_rad + 0.1)
    assert similar.path_id == turned.path_id
    assert plan_until_found(planner, moved_w, 0.6).finished


def update_standing_body(
    planner: ClutterPlanner, body_w: np.ndarray, count: int, heading_rad: float | None = None
) -> list[Trajectory]:
    """Return the trajectories of several updates, in which the body stays where it is."""
    desired = DesiredMotion(SPEED_M_S, heading_w_rad=heading_rad)
    return [
        planner.update(20 * k, make_world_at(0.01 * k, []), body_w, desired) for k in range(count)
    ]


def test_planner_follows_old_path_while_it_searches_a_new_one() -> None:
    obstacles, body_w = make_random_scene()
    planner = make_planner(obstacles)
    route = Route(np.concatenate([body_w, body_w[-1] + np.array([[1.0, 0.0], [5.0, 0.0]])]))
    planner.follow_route(route, ["peg"])
    trajectories = update_standing_body(planner, body_w, 6, heading_rad=0.7)
    searching = [trajectory for trajectory in trajectories if trajectory.searching]
    assert 1 <= len(searching) <= 4
    max_nodes = UPDATE_PERIOD_S * NODES_PER_S
    assert all(trajectory.searched_nodes <= max_nodes for trajectory in trajectories)
    for trajectory in searching:
        assert trajectory.searching == "the direction has changed"
        assert trajectory.searched_nodes > 0.5 * max_nodes
        assert trajectory.path_id == 0
        assert trajectory.speed_m_s == SPEED_M_S
        assert trajectory.push_points == ["peg"]
        assert np.array_equal(trajectory.path_w, route.points_w)
    replanned = trajectories[len(searching) :]
    assert {trajectory.path_id for trajectory in replanned} == {1}
    assert replanned[1].searched_nodes == 0
    # The new path begins with the old one.
    new_path_w = np.array(replanned[0].path_w)
    old_path_w = route.compute_positions_w(route.length_m - 6.0 + np.arange(0.02, 0.1, 0.02))
    assert max(np.hypot(*(new_path_w - point_w).T).min() for point_w in old_path_w) < 0.01


def test_plan_is_the_same_in_many_or_few_updates() -> None:
    obstacles, body_w = make_random_scene()
    planners = [
        ClutterPlanner(HeadingGoal(), obstacles, search_parameters=SEARCH, update_period_s=period_s)
        for period_s in (0.08, 0.5)
    ]
    in_many_updates, in_few_updates = (
        update_standing_body(planner, body_w, 40)[-1] for planner in planners
    )
    assert in_many_updates.path_id == 1
    assert in_many_updates.path_w == in_few_updates.path_w


def test_planner_before_first_path_requests_no_speed() -> None:
    obstacles, body_w = make_random_scene()
    planner = make_planner(obstacles)
    first = update_standing_body(planner, body_w, 1)[0]
    assert not planner.has_plan
    assert first.speed_m_s == 0.0
    assert first.searching == "the first path"
    assert first.reason == "the first path: a path is being searched"
    moving = update_standing_body(planner, body_w, 30)[-1]
    assert planner.has_plan
    assert moving.speed_m_s == SPEED_M_S
    assert moving.searching == ""
    assert moving.reason == ""


def test_planner_repeated_world_model_counts_as_one_update() -> None:
    obstacles, body_w = make_random_scene()
    planner = make_planner(None)
    assert plan_until_found(planner, body_w).path_id == 1
    world = make_world_at(4.0, obstacles)
    trajectories = [planner.update(400, world, body_w, DesiredMotion(SPEED_M_S)) for _ in range(20)]
    assert trajectories[0].searching == "the map has changed"
    assert trajectories[-1] == trajectories[0]


@pytest.mark.parametrize(
    ("is_perceived", "period_s"),
    [
        (False, 0.2),
        *(
            pytest.param(*values, marks=pytest.mark.slow)
            for values in ((True, 0.2), (False, 0.02), (True, 0.02))
        ),
    ],
)
def test_planner_work_of_each_update_is_bounded(is_perceived: bool, period_s: float) -> None:
    """Nodes are counted. CPU time may be ten times what the rate allows, so that a slow computer passes.

    The body does not move, so that the planner finds stuck paths, backs out, and at last turns to the left.
    """
    obstacles, body_w = make_random_scene(density_per_m2=12.0)
    planner = ClutterPlanner(
        HeadingGoal(),
        None if is_perceived else obstacles,
        search_parameters=SEARCH,
        update_period_s=period_s,
    )
    searched_nodes: list[int] = []
    path_ids: set[int] = set()
    durations_s: list[float] = []
    for k in range(round(12.0 / period_s)):
        time_s = k * period_s
        desired = DesiredMotion(SPEED_M_S, heading_w_rad=None if time_s < 8.0 else 0.7)
        started_s = time.thread_time()
        trajectory = planner.update(k, make_world_at(time_s, obstacles), body_w, desired)
        durations_s.append(time.thread_time() - started_s)
        searched_nodes.append(trajectory.searched_nodes)
        path_ids.add(trajectory.path_id)
    assert len(path_ids) > 3
    nodes_per_update = NODES_PER_S * period_s
    assert max(searched_nodes) <= max(nodes_per_update, MAX_FIT_NODES)
    assert all(
        sum(searched_nodes[: k + 1]) <= nodes_per_update * (k + 1)
        for k in range(len(searched_nodes))
    )
    assert max(durations_s) < 10 * max(period_s, MAX_FIT_NODES / NODES_PER_S)
