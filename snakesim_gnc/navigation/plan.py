"""One plan: a path for the whole body, from where it lies towards the goal. Pure.

`search_plan` is a generator like the searches of `beam`: it yields the cost of its next step, in nodes to expand,
before doing the step. The plan depends on the arguments alone, not on how many steps the caller does at a time.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from snakesim_gnc.geometry.planar import SPACING_M, resample_evenly
from snakesim_gnc.navigation.obstacle_grid import NO_OBSTACLE, ObstacleGrid
from snakesim_gnc.navigation.path_fit import PathFitParameters, fit_path
from snakesim_gnc.navigation.path_search.beam import BeamSearch, PathSearchSteps
from snakesim_gnc.navigation.path_search.search_parameters import MIN_PUSH, STEP_M, SearchParameters
from snakesim_gnc.navigation.path_search.search_task import SearchedPath
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle

# Reasons for a plan; `Trajectory.searching` shows them.
START = "the first path"
ENDS_SOON = "the path ends soon"
MAP_CHANGED = "the map has changed"
GOAL_TURNED = "the direction has changed"
OFF_PATH = "the body is off its path"
SHIFTED = "the body has left the place where it stood"
STUCK = "the body stands"
BACKED_OUT = "the body has backed out"

# Lengths of path that are searched ahead of the head.
LONG_HORIZON_M = 4.4  # of a path that does not begin with the current one
HORIZON_M = 2.0
# Of the current path ahead of where the head will be: it does not change any more.
COMMITTED_M = 0.05
MIN_ARCS_AHEAD = 10  # of a path for the whole body, beyond its head; a shorter one is a dead end

# The search for a path of the whole body.
MAX_SIDEWAYS_M = (0.05, 0.09)  # how far the path may be from the body: tried in this order
MIN_COST_IMPROVEMENT_M = 0.1  # a path farther away must cost less by this
GOOD_MARGIN_RATIO = 0.5  # of the wanted margin: with more, no path farther away is tried
GOOD_MARGIN_ARCS = 6  # over which the margin must be good, from where the head lies

# The search for the first path on a known map is wider: the robot does not move yet.
FIRST_KEPT_NODES = 2700
FIRST_KEPT_PER_WIDE_CELL = 48

# Between where the head points and the direction of one path; later paths turn further.
MAX_TURN_RAD = 1.2
# Between the path's begin and the trail behind it; nearer points would fold the path.
MIN_TRAIL_GAP_M = 0.1
MAX_TRAIL_POINTS = 20  # that a path begins with
MOVABLE_HEAD_POINTS = 3  # at the head end of the body that the path fit may move
MAX_REPORTED_PUSH_POINTS = 512  # push-points in a message
# Nodes that could be expanded in the time that the path fit takes for a point.
NODES_PER_FITTED_POINT = 12


@dataclass(frozen=True)
class PushPlan:
    """A path, and the obstacles that the body pushes off on it."""

    route: Route
    push_points: list[str]


@dataclass(frozen=True)
class PlanningTask:
    """What a plan is made from. Points are in the world frame."""

    reason: str
    body_w: Floats  # (n, 2) evenly spaced, tail to head
    goal_w: Floats  # (2,) unit vector
    obstacles: ObstacleGrid | Sequence[KnownObstacle]
    route: Route  # the current one
    committed_m: float  # length of the current route ahead of the head that stays
    failed_w: Floats | None  # (k, 2) points of paths on which the body got stuck here
    trail_w: list[Floats]  # (2,) each: where the tail was, the newest last


def search_plan(task: PlanningTask, parameters: SearchParameters) -> Generator[int, None, PushPlan]:
    """Search a path for the reason of a task, fit it to the obstacles beside it, and return it with its push-points.

    It is a generator, so that a planner can spread the work over several ticks. If no path is found, the plan goes
    straight ahead.

    Args:
        task: Why a path is needed, the body, the map and the goal.
        parameters: The robot, and the cost weights of the search.

    Yields:
        The cost of the next step in nodes, before doing it.
    """
    if isinstance(task.obstacles, ObstacleGrid):
        grid = task.obstacles
        if task.reason == START:
            parameters = replace(
                parameters, kept_nodes=FIRST_KEPT_NODES, kept_per_wide_cell=FIRST_KEPT_PER_WIDE_CELL
            )
    else:
        grid = yield from ObstacleGrid.build_in_steps(task.obstacles)
    joined_path_w, searched_path = yield from _search_path(task, grid, parameters)
    if searched_path is None:
        points_w = make_straight_path(task.body_w)
    else:
        points_w = np.concatenate(
            [joined_path_w, resample_evenly(searched_path.points_w)[min(len(joined_path_w), 1) :]]
        )
        yield NODES_PER_FITTED_POINT * len(points_w)
        fit_parameters = PathFitParameters(
            radius_m=parameters.radius_m, segment_m=parameters.segment_m
        )
        fixed_point_count = max(len(joined_path_w) - MOVABLE_HEAD_POINTS, 0)
        points_w = fit_path(points_w, fixed_point_count, grid, task.goal_w, fit_parameters)
    points_w = _prepend_trail(points_w, task.trail_w)
    push_points = _find_push_points(points_w, grid, task.goal_w, parameters.radius_m)
    return PushPlan(Route(points_w), push_points)


def make_straight_path(body_w: Floats) -> Floats:
    """Return a path along the body (n, 2) that continues straight ahead from its head for 1 m."""
    ahead = body_w[-1] - body_w[-4]
    distances_m = np.linspace(0.1, 1.0, 10)[:, None]
    return np.concatenate([body_w, body_w[-1] + distances_m * ahead / np.hypot(ahead[0], ahead[1])])


def compute_limited_heading_rad(body_w: Floats, goal_w: Floats) -> float:
    """Return the heading of the goal, limited to what one path can turn the head by.

    Args:
        body_w: (n, 2) evenly spaced points along the body, tail to head, m.
        goal_w: (2,) direction of the goal.

    Returns:
        Heading in the world in rad, at most MAX_TURN_RAD from where the head points.
    """
    x, y = body_w[-1] - body_w[-4]
    head_rad = math.atan2(y, x)
    turn_rad = math.remainder(math.atan2(goal_w[1], goal_w[0]) - head_rad, math.tau)
    return head_rad + min(max(turn_rad, -MAX_TURN_RAD), MAX_TURN_RAD)


def _search_path(
    task: PlanningTask, grid: ObstacleGrid, parameters: SearchParameters
) -> Generator[int, None, tuple[Floats, SearchedPath | None]]:
    """Run the search that fits the reason of the plan: from the head or from the current path, or for the whole body.

    Args:
        task: Why a path is needed, the body and the goal.
        grid: The map.
        parameters: The robot, and the cost weights of the search.

    Yields:
        The cost of the next step in nodes, before doing it.

    Returns:
        The curve (k, 2) to which the searched path is joined, which is empty for a path of the whole body; and the
        searched path, None if there is none.
    """
    beam = BeamSearch(grid, parameters)
    heading_rad = compute_limited_heading_rad(task.body_w, task.goal_w)
    if task.reason in (ENDS_SOON, MAP_CHANGED, GOAL_TURNED):
        joined_path_w = _get_committed_path(task, parameters.body_length_m)
        path = yield from beam.search_ahead(joined_path_w, heading_rad, round(HORIZON_M / STEP_M))
        return joined_path_w, path
    if task.reason in (START, OFF_PATH, SHIFTED):
        horizon_m = HORIZON_M if task.reason == SHIFTED else LONG_HORIZON_M
        path = yield from beam.search_ahead(task.body_w, heading_rad, round(horizon_m / STEP_M))
        return task.body_w, path
    path = yield from _search_whole_body(beam, task, parameters, heading_rad)
    return task.body_w[:0], path


def _get_committed_path(task: PlanningTask, body_length_m: float) -> Floats:
    """Return the part of the current path that a new plan keeps.

    Args:
        task: The current path and the body.
        body_length_m: Length of the body.

    Returns:
        (k, 2) points from the tail to where the head will be when the plan is complete, m. If the path crosses itself
        near the body, these are the points of the body.
    """
    route = task.route
    tail_s_m = route.project_point(task.body_w[0])
    head_s_m = route.project_point(task.body_w[-1], tail_s_m + body_length_m)
    if head_s_m - tail_s_m <= 0.5 * body_length_m:
        # The path crosses itself, so that the projections of tail and head are on the wrong branches.
        return task.body_w
    committed_m = max(min(task.committed_m, route.length_m - head_s_m), COMMITTED_M)
    return resample_evenly(
        route.compute_positions_w(np.arange(tail_s_m, head_s_m + committed_m, SPACING_M))
    )


def _search_whole_body(
    beam: BeamSearch, task: PlanningTask, parameters: SearchParameters, heading_rad: float
) -> PathSearchSteps:
    """Search a path for the whole body that changes its shape as little as possible, and on which it can push well.

    The search is repeated with wider limits until a path has a good propulsion margin ahead of the head.

    Args:
        beam: The search.
        task: The body, and the paths that have failed.
        parameters: The robot, and the desired propulsion margin in N.
        heading_rad: Direction of travel.

    Returns:
        The path, or None if none of the searches found one that is long enough.
    """
    best: SearchedPath | None = None
    head_arc = round(parameters.body_length_m / STEP_M)
    for max_sideways_m in MAX_SIDEWAYS_M:
        path = yield from beam.search_whole_body(
            task.body_w, heading_rad, round(HORIZON_M / STEP_M), max_sideways_m, task.failed_w
        )
        if path is None or len(path.points_w) < head_arc + MIN_ARCS_AHEAD:
            continue
        if best is None or path.cost_m < best.cost_m - MIN_COST_IMPROVEMENT_M:
            best = path
        margins_n = path.margins_n[head_arc : head_arc + GOOD_MARGIN_ARCS]
        if np.min(margins_n) > GOOD_MARGIN_RATIO * parameters.wanted_margin_n:
            break
    return best


def _prepend_trail(points_w: Floats, trail_w: Sequence[Floats]) -> Floats:
    """Return the path with the trail of the tail before it, along which the body can back out.

    Args:
        points_w: (n, 2) the path, tail to head, m.
        trail_w: Positions (2,) where the tail was, the newest last.
    """
    start_direction = points_w[5] - points_w[0]
    start_direction /= max(float(np.hypot(start_direction[0], start_direction[1])), 1e-9)
    trail_behind = [
        point_w
        for point_w in trail_w
        if (point_w - points_w[0]) @ start_direction < -MIN_TRAIL_GAP_M
    ]
    if not trail_behind:
        return points_w
    return np.concatenate([np.array(trail_behind[-MAX_TRAIL_POINTS:]), points_w])


def _find_push_points(
    points_w: Floats, grid: ObstacleGrid, goal_w: Floats, radius_m: float
) -> list[str]:
    """Return the names of obstacles that a body on the path touches and that push it on, in order along the path."""
    nearest = grid.find_nearest(points_w[:, 0], points_w[:, 1])
    is_contact = (nearest.obstacle_index != NO_OBSTACLE) & (
        nearest.distance_m < radius_m + PathFitParameters.contact_gap_m
    )
    is_push_point = is_contact & (nearest.normal_w @ goal_w > MIN_PUSH)
    indices = dict.fromkeys(nearest.obstacle_index[is_push_point].tolist())  # each once, in order
    return [grid.obstacles[index].name for index in indices][:MAX_REPORTED_PUSH_POINTS]
