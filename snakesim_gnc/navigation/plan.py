"""One plan: a path for the whole body, from where it lies to where the goal is. Pure.

`plan` is a generator as the searches of `beam` are: it yields what its next step costs, in nodes to expand, before it
does it. It depends on its arguments alone, so the path is the same in however many slices it was made.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from snakesim_gnc.navigation.beam import MIN_TOWARDS, STEP_M, Beam, PathSearch, PlannedPath, Search
from snakesim_gnc.navigation.line import SPACING_M, evenly
from snakesim_gnc.navigation.obstacle_map import NONE, ObstacleMap
from snakesim_gnc.navigation.snap import Fit, snap
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Obstacle

START, STANDS, BACKED_OUT = "the first path", "the body stands", "the body has backed out"
ENDS_SOON, MAP_CHANGED, TURNED = "the path ends soon", "the map has changed", "the direction has changed"
LOST, SHIFTED = "the body is off its path", "the body has left the place where it stood"
HORIZON_M = 4.4
AGAIN_M = 2.0
REACHES_M = (0.05, 0.09)
COMMITTED_M = 0.05  # of the path ahead of where the head will be that is not changed any more
SHARPEST_RAD = 1.2  # a path begins with no greater turn from where the head points; further ones follow
FIRST_WIDTH, FIRST_CROWD = 2700, 48  # of the search of the first path on a known map
MIN_AHEAD = 10  # arcs of a new path beyond the head
JOIN_M = 0.1  # between a path and the trail: nearer, and beside its begin, they would fold it
TRAIL = 20  # points of the trail that a path keeps
MAX_REPORTED = 512  # push-points in a message
SNAP_NODES = 12  # that could be expanded in the time that a point in `snap` takes


@dataclass(frozen=True)
class Planned:
    """A path, and what the body is to push off on it."""

    route: Route
    push_points: list[str]


@dataclass(frozen=True)
class Situation:
    """What a plan is made from."""

    why: str
    body_w: Floats  # (n, 2) evenly spaced, tail to head
    goal: Floats  # (2,) unit vector
    obstacles: ObstacleMap | Sequence[Obstacle]
    route: Route  # the present one
    committed_m: float  # of it, ahead of the head
    failed_w: Floats | None  # (k, 2) of paths on which the body got stuck here
    trail_w: list[Floats]  # where the tail was, the newest last


def plan(situation: Situation, search: Search) -> Generator[int, None, Planned]:
    """The path for a situation."""
    why, body, goal, obstacles = situation.why, situation.body_w, situation.goal, situation.obstacles
    known = isinstance(obstacles, ObstacleMap)
    if not isinstance(obstacles, ObstacleMap):
        obstacles = yield from ObstacleMap.in_steps(obstacles)
    if why == START and known:  # nobody waits for it while something moves
        search = replace(search, kept_nodes=FIRST_WIDTH, kept_per_wide_cell=FIRST_CROWD)
    beam, heading_rad = Beam(obstacles, search), within_reach(body, goal)
    begin, kept = body, len(body) - 3
    if why in (ENDS_SOON, MAP_CHANGED, TURNED):
        begin = _lies(situation, search.body_length_m)
        kept = len(begin) - 3
        found = yield from beam.ahead(begin, heading_rad, round(AGAIN_M / STEP_M))
    elif why in (START, LOST, SHIFTED):
        horizon_m = AGAIN_M if why == SHIFTED else HORIZON_M
        found = yield from beam.ahead(body, heading_rad, round(horizon_m / STEP_M))
    else:
        found = yield from _replanned(beam, situation, search, heading_rad)
        begin, kept = body[:0], 0
    if found is None:
        points = straight_on(body)
    else:
        points = np.concatenate([begin, evenly(found.points_w)[min(len(begin), 1) :]])
        yield SNAP_NODES * len(points)
        fit = Fit(radius_m=search.radius_m, segment_m=search.segment_m)
        points = snap(points, kept, obstacles, goal, fit)
    along = points[5] - points[0]
    along /= max(float(np.hypot(*along)), 1e-9)
    behind = [place for place in situation.trail_w if (place - points[0]) @ along < -JOIN_M][-TRAIL:]
    if behind:
        points = np.concatenate([np.array(behind), points])
    return Planned(Route(points), _pushed_off(points, obstacles, goal, search.radius_m))


def straight_on(body_w: Floats) -> Floats:
    """A path along the body, and straight on from its head."""
    ahead = body_w[-1] - body_w[-4]
    return np.concatenate([body_w, body_w[-1] + np.linspace(0.1, 1.0, 10)[:, None] * ahead / np.hypot(*ahead)])


def within_reach(body_w: Floats, goal: Floats) -> float:
    """Heading of a goal's direction, or as far towards it as the head can turn on one path."""
    x, y = body_w[-1] - body_w[-4]
    head_rad = math.atan2(y, x)
    turn_rad = math.remainder(math.atan2(goal[1], goal[0]) - head_rad, math.tau)
    return head_rad + min(max(turn_rad, -SHARPEST_RAD), SHARPEST_RAD)


def _lies(situation: Situation, body_length_m: float) -> Floats:
    """The present path as far as the body lies on it, and will have gone on when another one is there."""
    route, body = situation.route, situation.body_w
    tail_s = route.project(body[0])
    head_s = route.project(body[-1], tail_s + body_length_m)
    if head_s - tail_s <= 0.5 * body_length_m:  # a path that crosses itself does not tell the order of tail and head
        return body
    committed_m = max(min(situation.committed_m, route.length_m - head_s), COMMITTED_M)
    return evenly(route.position_w(np.arange(tail_s, head_s + committed_m, SPACING_M)))


def _replanned(beam: Beam, situation: Situation, search: Search, heading_rad: float) -> PathSearch:
    """A path for the whole body: the least change of shape that can push well."""
    best: PlannedPath | None = None
    arcs = round(search.body_length_m / STEP_M)
    for reach_m in REACHES_M:
        found = yield from beam.whole(
            situation.body_w, heading_rad, round(AGAIN_M / STEP_M), reach_m, situation.failed_w
        )
        if found is None or len(found.points_w) < arcs + MIN_AHEAD:
            continue
        if best is None or found.cost_m < best.cost_m - 0.1:
            best = found
        if np.min(found.margins_n[arcs : arcs + 6]) > 0.5 * search.wanted_margin_n:
            break
    return best


def _pushed_off(points_w: Floats, obstacles: ObstacleMap, goal: Floats, radius_m: float) -> list[str]:
    """Obstacles that a body on the path touches or nearly does, and that push it on, in order along the path."""
    near = obstacles.near(points_w[:, 0], points_w[:, 1])
    beside = (near.distance_m < radius_m + Fit.touch_m) & (near.normal_w @ goal > MIN_TOWARDS)
    found = dict.fromkeys(near.obstacle[beside & (near.obstacle != NONE)].tolist())
    return [obstacles.obstacles[k].name for k in found][:MAX_REPORTED]
