"""The planner through clutter: decides when to plan another path, and limits the work in each update. Pure.

The first path begins with the body's measured curve, from tail to head; the search finds the path ahead of the head.
The planner plans again when the path ends soon, the map or the direction has changed, or the body has left its path. If
the body is stuck, it plans a path for the whole body, close to where the body lies, with contacts that can push. It
remembers the paths on which the body got stuck, and avoids them. Every third time at one place it backs out first,
along its own path and the trail of its tail.

An update does at most the work that the declared rate (`NODES_PER_S`) allows in its time. So no update waits for a
plan, and a plan takes the same robot time on every computer. Until it is there the present path counts, and
`Trajectory.searching` gives the reason for the next one.
"""

import math
import statistics
from collections import deque
from collections.abc import Generator, Sequence

import numpy as np

from snakesim_gnc.geometry.planar import space_evenly
from snakesim_gnc.navigation.intents import DesiredMotion
from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.native_library import is_native_available
from snakesim_gnc.navigation.path_search.search_parameters import STEP_M, SearchParameters
from snakesim_gnc.navigation.plan import (
    BACKED_OUT,
    COMMITTED_M,
    ENDS_SOON,
    GOAL_TURNED,
    HORIZON_M,
    MAP_CHANGED,
    MAX_TRAIL_POINTS,
    OFF_PATH,
    SHIFTED,
    START,
    STUCK,
    Plan,
    PlanningTask,
    extend_straight,
    limit_turn_rad,
    make_plan,
)
from snakesim_gnc.navigation.planning_goal import PlanningGoal
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import Obstacle, Trajectory, World

NODES_PER_S = 250_000  # of robot time: two fifths of what a core expands, see docs/concepts/path-planning.md

# When to plan again.
ENDS_SOON_M = 0.6  # of path ahead of the head
OFF_PATH_M = 0.12  # median distance of the body's points from the path: no correction leads back
SHIFTED_M = 0.03  # likewise, after a stall: control has moved the body while it searched for contacts
TURNED_RAD = 0.35  # a change of direction that matters
MAP_RADIUS_M = 1.5  # obstacles within this distance of the head count
MAP_TOLERANCE_M = 0.005  # a smaller change of their shapes does not matter

# When the body is stuck.
STUCK_S = 0.8
STUCK_M = 0.01  # the middle of the body moves less than this in STUCK_S
FORGET_FAILURES_M = 0.15  # along the goal, from where the body was stuck
MAX_FAILED_PATHS = 4
BACK_OUT_EVERY = 3  # stalls at one place
BACK_OUT_M = 0.1
BACK_OUT_S = 1.5  # the most that it takes
BACK_OUT_SPEED_RATIO = 0.5  # of the desired speed

TRAIL_SPACING_M = 0.03
MAX_REASON_LENGTH = 500


class ClutterPlanner:
    """Plans paths towards a goal, again and again."""

    def __init__(
        self,
        goal: HeadingGoal | WaypointGoal,
        known: Sequence[Obstacle] | None,
        *,
        search: SearchParameters,
        turn_s: float = 0.2,
    ) -> None:
        """Create a planner without a path.

        Args:
            goal: the mission's goal; a heading in the desired motion replaces it.
            known: the surveyed obstacles; None to use those of the world model.
            search: the robot, and the costs of the search.
            turn_s: from one update to the next, or the latency of the service if that is less.
        """
        is_native_available()  # loads the C library now, which may take seconds and must not happen in an update

        # Configuration.
        self._goal = PlanningGoal(goal, search.body_length_m)
        self._known = None if known is None else ObstacleGrid(known)
        self._search = search
        self._nodes_per_update = max(round(NODES_PER_S * turn_s), 1)
        replan_nodes = round(HORIZON_M / STEP_M) * search.kept_nodes
        self._planning_s = (replan_nodes / self._nodes_per_update + 1) * turn_s  # until another path is there

        # The present path.
        self._plan: Plan | None = None
        self._planned_ns = 0
        self._planned_heading_rad: float | None = None  # None: the path was not planned for a direction
        self._planned_shapes = np.empty((0, 5))  # obstacles around the head when it was planned
        self._path_id = 0  # the newest path of this planner; 0 is a path from elsewhere
        self._shown_path_id = 0
        self._tick = -1

        # The plan in work.
        self._planning: Generator[int, None, Plan] | None = None
        self._reason = ""
        self._next_nodes = 0  # cost of its next step
        self._saved_nodes = 0  # of updates whose share was too small for the next step
        self.searched_nodes = 0  # in the last update

        # Progress and stalls.
        self._recent_middles: deque[tuple[int, Floats]] = deque()
        self._failed_w: list[Floats] = []  # (k, 2) paths on which the body got stuck near here
        self._stuck_at_m = 0.0  # along the goal
        self._stalls = 0
        self._back_out_from_m: float | None = None  # arc length of the head where it began; None: not backing out
        self._back_out_until_ns = 0
        self._trail_w: list[Floats] = []

    @property
    def ready(self) -> bool:
        """Whether there is a path to follow."""
        return self._plan is not None and self._reason != START

    def follow(self, route: Route, push_points: list[str]) -> None:
        """Replace the path by one from elsewhere; a path that is planned later begins on it."""
        self._plan = Plan(route, push_points)
        self._shown_path_id = 0
        self._planned_heading_rad = None
        self._drop_work()
        self._back_out_from_m = None
        self._recent_middles.clear()
        self._failed_w.clear()
        self._trail_w.clear()

    def update(self, tick: int, world: World, nodes_w: Floats, desired: DesiredMotion) -> Trajectory:
        """Return the trajectory of this tick, and continue the search for a new path by a limited number of nodes.

        The trajectory has the last complete plan until the next one is found.

        Args:
            tick: tick of the clock; a repeated tick continues no search.
            world: the newest world model.
            nodes_w: (n, 2) tail end, joints and head end of the body in the world, m.
            desired: desired speed and direction.

        Returns:
            The path with its push-points, the speed, and the reason if the robot should not move.
        """
        body_w = space_evenly(nodes_w)
        self._goal.update(body_w, desired.heading_w_rad)
        if tick != self._tick or not self.ready:
            self._advance(body_w, world, desired)
        self._tick = tick
        plan = self._plan
        assert plan is not None
        speed_m_s, reason = self._choose_speed(desired)
        goal_x, goal_y = self._goal.position_w
        return Trajectory(
            tick=tick,
            timestamp_ns=world.timestamp_ns,
            path_id=self._shown_path_id,
            path_w=[(float(x), float(y)) for x, y in plan.route.points_w],
            speed_m_s=speed_m_s,
            push_points=plan.push_points,
            finished=self._goal.reached,
            reason=reason,
            searching=self._reason,
            searched_nodes=self.searched_nodes,
            assumed_obstacle_friction=self._search.assumed_obstacle_friction,
            goal_w=(float(goal_x), float(goal_y)),
        )

    def _choose_speed(self, desired: DesiredMotion) -> tuple[float, str]:
        """Return the speed along the path in m/s, and the reason if it is not the mission's."""
        if self._goal.reached:
            return 0.0, "the goal is reached"
        if self._reason in (START, BACKED_OUT):
            return 0.0, f"{self._reason}: a path is being searched"
        reason = desired.reason[:MAX_REASON_LENGTH]
        if self._back_out_from_m is not None:
            return desired.speed_m_s * -BACK_OUT_SPEED_RATIO, reason
        return desired.speed_m_s, reason

    def _advance(self, body_w: Floats, world: World, desired: DesiredMotion) -> None:
        """Decide whether another path is needed, and continue a plan in progress by one update's share.

        Without any plan yet, the first one is a straight line ahead of the body.

        Args:
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            world: the newest world model.
            desired: desired speed and direction.
        """
        self.searched_nodes = 0
        self._extend_trail(body_w[0])
        if self._plan is None:
            self._plan = Plan(Route(extend_straight(body_w)), [])
            self._shown_path_id = 0
            self._start_plan(START, body_w, world, 0.0)
        elif self._goal.reached or desired.speed_m_s == 0.0:
            self._recent_middles.clear()  # a body that must not move is not stuck
        else:
            committed_m = COMMITTED_M + max(desired.speed_m_s, 0.0) * self._planning_s
            moved_m = self._measure_movement_m(body_w, world.timestamp_ns)
            if self._planning is None:
                reason = self._find_reason(self._plan, body_w, world, moved_m, committed_m)
                if reason:
                    self._start_plan(reason, body_w, world, committed_m)
        if self._planning is not None:
            self._continue_plan(self._planning, world.timestamp_ns)

    def _start_plan(self, reason: str, body_w: Floats, world: World, committed_m: float) -> None:
        """Start to plan a path from the present position of the body; later updates continue it.

        Args:
            reason: why another path is needed; it decides whether the path begins at the head or at the tail.
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            world: the newest world model.
            committed_m: length of the present path ahead of the head that the new path keeps.
        """
        assert self._plan is not None
        self._planned_heading_rad = limit_turn_rad(body_w, self._goal.direction_w)
        if self._known is None:
            self._planned_shapes = _describe_shapes_near(body_w[-1], world.obstacles)
        task = PlanningTask(
            reason=reason,
            body_w=body_w,
            goal_w=self._goal.direction_w,
            obstacles=self._known or world.obstacles,
            route=self._plan.route,
            committed_m=committed_m,
            failed_w=np.concatenate(self._failed_w) if self._failed_w else None,
            trail_w=list(self._trail_w),
        )
        self._planning = make_plan(task, self._search)
        self._reason = reason
        self._next_nodes = next(self._planning)

    def _continue_plan(self, planning: Generator[int, None, Plan], now_ns: int) -> None:
        """Do the steps of a plan that this update can afford; use the plan when it is complete."""
        affordable_nodes = self._saved_nodes + self._nodes_per_update
        while self._next_nodes <= affordable_nodes:
            affordable_nodes -= self._next_nodes
            self.searched_nodes += self._next_nodes
            try:
                self._next_nodes = next(planning)
            except StopIteration as done:
                self._use_plan(done.value, now_ns)
                return
        self._saved_nodes = 0 if self.searched_nodes else affordable_nodes

    def _use_plan(self, plan: Plan, now_ns: int) -> None:
        self._plan = plan
        self._planned_ns = now_ns
        self._path_id += 1
        self._shown_path_id = self._path_id
        if self._reason != MAP_CHANGED:
            # After a changed map they stay: a map that keeps changing must not hide that the body is stuck.
            self._recent_middles.clear()
        self._drop_work()

    def _drop_work(self) -> None:
        self._planning = None
        self._reason = ""
        self._saved_nodes = 0

    def _measure_movement_m(self, body_w: Floats, now_ns: int) -> float | None:
        """Return how far the body's middle has moved within STUCK_S; None if it is not known for as long."""
        recent = self._recent_middles
        middle_w = body_w.mean(axis=0)
        recent.append((now_ns, middle_w))
        while now_ns - recent[0][0] > STUCK_S * 1e9:
            recent.popleft()
        oldest_ns, oldest_w = recent[0]
        if now_ns - oldest_ns <= 0.8e9 * STUCK_S:
            return None
        return float(np.hypot(*(middle_w - oldest_w)))

    def _find_reason(self, plan: Plan, body_w: Floats, world: World, moved_m: float | None, committed_m: float) -> str:
        """Return why another path is needed, or an empty string. It also starts and ends the backing out of a jam.

        Reasons are checked in order of urgency: the body is off its path, the path ends soon, the body is stuck, the
        goal has turned, the map has changed.

        Args:
            plan: the present plan.
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            world: the newest world model.
            moved_m: movement of the body within the last STUCK_S; None if it is not known yet.
            committed_m: length of the path ahead of the head that a new path keeps.
        """
        now_ns = world.timestamp_ns
        head_s_m = plan.route.project(body_w[-1])
        if self._back_out_from_m is not None:
            return self._check_backed_out(self._back_out_from_m, head_s_m, now_ns)
        from_path_m = statistics.median(_distance_from_route_m(plan.route, point_w) for point_w in body_w[::10])
        if from_path_m > OFF_PATH_M:
            return OFF_PATH
        if self._failed_w and from_path_m > SHIFTED_M and now_ns - self._planned_ns > STUCK_S * 1e9:
            return SHIFTED
        if plan.route.length_m - head_s_m < ENDS_SOON_M + committed_m - COMMITTED_M:
            return ENDS_SOON
        if moved_m is not None and moved_m < STUCK_M:
            return self._handle_stall(plan.route, body_w, head_s_m, now_ns)
        if self._failed_w:
            return ""  # the way out of a jam comes first
        if self._has_goal_turned(body_w):
            return GOAL_TURNED
        if self._known is None and self._has_map_changed(body_w[-1], world.obstacles):
            return MAP_CHANGED
        return ""

    def _check_backed_out(self, from_s_m: float, head_s_m: float, now_ns: int) -> str:
        """End backing out when the head is far enough back, or after a time."""
        if from_s_m - head_s_m > BACK_OUT_M or now_ns > self._back_out_until_ns:
            self._back_out_from_m = None
            return BACKED_OUT
        return ""

    def _has_goal_turned(self, body_w: Floats) -> bool:
        """Return whether the present path was planned for another direction."""
        if self._planned_heading_rad is None:
            return True
        heading_rad = limit_turn_rad(body_w, self._goal.direction_w)
        return abs(math.remainder(heading_rad - self._planned_heading_rad, math.tau)) > TURNED_RAD

    def _has_map_changed(self, head_w: Floats, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether the map around the head differs from the one that the present path was planned on."""
        planned = self._planned_shapes
        shapes = _describe_shapes_near(head_w, obstacles)
        if len(planned) != len(shapes):
            return True
        return bool(len(shapes) and np.abs(planned - shapes).max() >= MAP_TOLERANCE_M)

    def _handle_stall(self, route: Route, body_w: Floats, head_s_m: float, now_ns: int) -> str:
        """Remember the path on which the body is stuck. Return the reason to plan, or start to back out."""
        place_m = float(body_w.mean(axis=0) @ self._goal.direction_w)
        if self._failed_w and abs(place_m - self._stuck_at_m) > FORGET_FAILURES_M:
            self._failed_w.clear()
        if not self._failed_w:
            self._stuck_at_m = place_m
            self._stalls = 0
        tail_s_m = route.project(body_w[0])
        self._failed_w.append(route.position_w(np.arange(tail_s_m, head_s_m + 0.1, 0.025)))
        self._failed_w = self._failed_w[-MAX_FAILED_PATHS:]
        self._stalls += 1
        if self._stalls % BACK_OUT_EVERY:
            return STUCK
        self._back_out_from_m = head_s_m
        self._back_out_until_ns = now_ns + round(BACK_OUT_S * 1e9)
        return ""

    def _extend_trail(self, tail_w: Floats) -> None:
        """Record where the tail was. A tail that goes back along the trail shortens it."""
        trail = self._trail_w
        if trail and np.hypot(*(trail[-1] - tail_w)) <= TRAIL_SPACING_M:
            return
        goes_back = len(trail) > 1 and float((tail_w - trail[-1]) @ (trail[-1] - trail[-2])) < 0
        if goes_back:
            trail.pop()
        else:
            trail.append(tail_w)
        del trail[: -2 * MAX_TRAIL_POINTS]


def _describe_shapes_near(head_w: Floats, obstacles: Sequence[Obstacle]) -> Floats:
    """Return center, half size and rounding of the obstacles around the head, (k, 5) in m."""
    outlines = Outlines.from_obstacles(obstacles)
    offset = outlines.center_w - head_w
    is_near = np.hypot(offset[:, 0], offset[:, 1]) < MAP_RADIUS_M
    return np.column_stack([outlines.center_w, outlines.half_m, outlines.rounding_m])[is_near]


def _distance_from_route_m(route: Route, point_w: Floats) -> float:
    return float(np.hypot(*(route.position_w(route.project(point_w)) - point_w)))
