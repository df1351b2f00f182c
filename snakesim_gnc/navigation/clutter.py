"""The planner through clutter: decides when to plan another path, and limits the work in each update. Pure.

The first path begins with the body's measured curve, from tail to head; the search finds the path ahead of the head.
The planner plans again when the path ends soon, the map or the direction has changed, or the body has left its path. If
the body is stuck, it plans a path for the whole body, close to where the body lies, with contacts that can push. It
remembers the paths on which the body got stuck, and avoids them. Every third time at one place it backs out first,
along its own path and the trail of its tail.

An update does at most the work that the declared rate (`NODES_PER_S`) allows in its time. So no update waits for a
plan, and a plan takes the same robot time on every computer. Until it is there the current path counts, and
`Trajectory.searching` gives the reason for the next one.
"""

import math
import statistics
from collections import deque
from collections.abc import Generator, Sequence

import numpy as np

from snakesim_gnc.geometry.planar import resample_evenly
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
    PlanningTask,
    PushPlan,
    compute_limited_heading_rad,
    make_straight_path,
    search_plan,
)
from snakesim_gnc.navigation.planning_goal import PlanningGoal
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import KnownObstacle, Trajectory, WorldModel

# Of robot time: two fifths of what a core expands, see docs/concepts/path-planning.md.
NODES_PER_S = 250_000

# When to plan again.
MIN_PATH_AHEAD_M = 0.6  # of path ahead of the head
# Median distance of the body's points from the path: no correction leads back.
MAX_PATH_DISTANCE_M = 0.12
# Likewise, after a stall: control has moved the body while it searched for contacts.
MIN_SHIFT_M = 0.03
MIN_GOAL_TURN_RAD = 0.35  # a change of direction that matters
MAP_RADIUS_M = 1.5  # obstacles within this distance of the head count
MAP_TOLERANCE_M = 0.005  # a smaller change of their shapes does not matter

# When the body is stuck.
STUCK_DURATION_S = 0.8
MAX_STUCK_DISTANCE_M = 0.01  # the middle of the body moves less than this in STUCK_DURATION_S
FAILURE_MEMORY_DISTANCE_M = 0.15  # along the goal, from where the body was stuck
MAX_FAILED_PATHS = 4
STALLS_PER_BACK_OUT = 3  # stalls at one place
BACK_OUT_DISTANCE_M = 0.1
MAX_BACK_OUT_DURATION_S = 1.5  # the most that it takes
BACK_OUT_SPEED_RATIO = 0.5  # of the desired speed

TRAIL_SPACING_M = 0.03
MAX_REASON_LENGTH = 500


class ClutterPlanner:
    """Plans paths towards a goal, again and again."""

    def __init__(
        self,
        goal: HeadingGoal | WaypointGoal,
        known_obstacles: Sequence[KnownObstacle] | None,
        *,
        search_parameters: SearchParameters,
        update_period_s: float = 0.2,
    ) -> None:
        """Create a planner that has no path yet, and build the grid of the surveyed obstacles.

        Args:
            goal: The mission's goal; a heading in the desired motion replaces it.
            known_obstacles: The surveyed obstacles; None to use those of the world model.
            search_parameters: The robot, and the costs of the search.
            update_period_s: Time from one update to the next, or the latency of the service if that is less. It limits
                the work of one update.
        """
        is_native_available()  # loads the C library now, which may take seconds and must not happen in an update

        # Configuration.
        self._goal = PlanningGoal(goal, search_parameters.body_length_m)
        self._known_obstacle_grid = (
            None if known_obstacles is None else ObstacleGrid(known_obstacles)
        )
        self._search_parameters = search_parameters
        self._nodes_per_update = max(round(NODES_PER_S * update_period_s), 1)
        replan_nodes = round(HORIZON_M / STEP_M) * search_parameters.kept_nodes
        # Robot time from the decision to plan until the new path is complete.
        self._planning_duration_s = (replan_nodes / self._nodes_per_update + 1) * update_period_s

        # The path that is followed.
        self._plan: PushPlan | None = None
        self._plan_time_ns = 0
        # None if the path was not planned for a direction.
        self._planned_heading_rad: float | None = None
        # Obstacles around the head when it was planned.
        self._planned_obstacle_shapes = np.empty((0, 5))
        self._newest_path_id = 0  # the newest path of this planner; 0 is a path from elsewhere
        self._published_path_id = 0
        self._last_tick = -1

        # The plan that is being searched.
        self._running_plan: Generator[int, None, PushPlan] | None = None
        self._search_reason = ""  # why it is searched; empty if none is
        self._next_step_cost_nodes = 0  # cost of its next step, in nodes to expand
        self._saved_node_budget = 0  # left over from updates that could not afford the next step
        self.expanded_nodes = 0  # number of nodes that were expanded in the last update

        # Progress and stalls.
        self._recent_body_middles: deque[tuple[int, Floats]] = deque()
        self._failed_w: list[Floats] = []  # (k, 2) paths on which the body got stuck near here
        self._first_stall_position_m = 0.0  # along the goal
        self._stall_count = 0
        # Arc length of the head where it began; None if the body is not backing out.
        self._back_out_start_s_m: float | None = None
        self._back_out_end_ns = 0
        self._trail_w: list[Floats] = []

    @property
    def has_plan(self) -> bool:
        """Whether a path has been planned or given, so that the robot can follow it."""
        return self._plan is not None and self._search_reason != START

    def follow_route(self, route: Route, push_points: list[str]) -> None:
        """Replace the path by a given route, and discard the running search and all memory of stalls.

        Args:
            route: The route to follow. A path that is planned later begins on it.
            push_points: Names of the obstacles that the body pushes off on it.
        """
        self._plan = PushPlan(route, push_points)
        self._published_path_id = 0
        self._planned_heading_rad = None
        self._discard_running_plan()
        self._back_out_start_s_m = None
        self._recent_body_middles.clear()
        self._failed_w.clear()
        self._trail_w.clear()

    def update(
        self, tick: int, world: WorldModel, body_points_w: Floats, desired: DesiredMotion
    ) -> Trajectory:
        """Return the trajectory of this tick, and expand at most a fixed number of nodes of the running path search.

        Until a new plan is complete, the last complete plan is returned.

        Args:
            tick: Tick of the clock. Calling it again with the same tick does not advance the search.
            world: The newest world model.
            body_points_w: (n, 2) tail end, joints and head end of the body in the world, m.
            desired: Desired speed and direction.

        Returns:
            The path with its push-points, the speed, and the reason if the robot should not move.
        """
        body_w = resample_evenly(body_points_w)
        self._goal.update(body_w, desired.heading_w_rad)
        if tick != self._last_tick or not self.has_plan:
            self._start_or_continue_plan(body_w, world, desired)
        self._last_tick = tick
        plan = self._plan
        # `_start_or_continue_plan` makes a straight one if there is none yet.
        assert plan is not None
        speed_m_s, hold_reason = self._choose_speed_and_reason(desired)
        goal_x, goal_y = self._goal.position_w
        return Trajectory(
            tick=tick,
            timestamp_ns=world.timestamp_ns,
            path_id=self._published_path_id,
            path_w=[(float(x), float(y)) for x, y in plan.route.points_w],
            speed_m_s=speed_m_s,
            push_points=plan.push_points,
            finished=self._goal.is_reached,
            reason=hold_reason,
            searching=self._search_reason,
            searched_nodes=self.expanded_nodes,
            # The controller must push with the same friction for which the search has found contacts.
            assumed_obstacle_friction=self._search_parameters.assumed_obstacle_friction,
            goal_w=(float(goal_x), float(goal_y)),
        )

    def _choose_speed_and_reason(self, desired: DesiredMotion) -> tuple[float, str]:
        """Return the speed along the path in m/s, negative to back out, and the reason if it is not the mission's."""
        if self._goal.is_reached:
            return 0.0, "the goal is reached"
        if self._search_reason in (START, BACKED_OUT):
            return 0.0, f"{self._search_reason}: a path is being searched"
        reason = desired.reason[:MAX_REASON_LENGTH]
        if self._back_out_start_s_m is not None:
            return desired.speed_m_s * -BACK_OUT_SPEED_RATIO, reason
        return desired.speed_m_s, reason

    def _start_or_continue_plan(
        self, body_w: Floats, world: WorldModel, desired: DesiredMotion
    ) -> None:
        """Start a search if another path is needed, and continue the running search by the work of one update.

        At the first call the plan becomes a straight line ahead of the body, so that there is always one afterwards.

        Args:
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            world: The newest world model.
            desired: Desired speed and direction.
        """
        self.expanded_nodes = 0
        self._update_tail_trail(body_w[0])
        if self._plan is None:
            self._plan = PushPlan(Route(make_straight_path(body_w)), [])
            self._published_path_id = 0
            self._start_plan(START, body_w, world, 0.0)
        elif self._goal.is_reached or desired.speed_m_s == 0.0:
            self._recent_body_middles.clear()  # a body that must not move is not stuck
        else:
            committed_m = COMMITTED_M + max(desired.speed_m_s, 0.0) * self._planning_duration_s
            moved_m = self._measure_movement_m(body_w, world.timestamp_ns)
            if self._running_plan is None:
                reason = self._find_replanning_reason(
                    self._plan, body_w, world, moved_m, committed_m
                )
                if reason:
                    self._start_plan(reason, body_w, world, committed_m)
        if self._running_plan is not None:
            self._continue_plan(self._running_plan, world.timestamp_ns)

    def _start_plan(
        self, reason: str, body_w: Floats, world: WorldModel, committed_m: float
    ) -> None:
        """Start to plan a path from the current position of the body; later updates continue it.

        Args:
            reason: Why another path is needed; it decides whether the path begins at the head or at the tail.
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            world: The newest world model.
            committed_m: Length of the current path ahead of the head that the new path keeps.
        """
        assert self._plan is not None
        self._planned_heading_rad = compute_limited_heading_rad(body_w, self._goal.direction_w)
        if self._known_obstacle_grid is None:
            self._planned_obstacle_shapes = _describe_obstacle_shapes_near(
                body_w[-1], world.obstacles
            )
        task = PlanningTask(
            reason=reason,
            body_w=body_w,
            goal_w=self._goal.direction_w,
            obstacles=self._known_obstacle_grid or world.obstacles,
            route=self._plan.route,
            committed_m=committed_m,
            failed_w=np.concatenate(self._failed_w) if self._failed_w else None,
            trail_w=list(self._trail_w),
        )
        self._running_plan = search_plan(task, self._search_parameters)
        self._search_reason = reason
        self._next_step_cost_nodes = next(self._running_plan)

    def _continue_plan(self, running_plan: Generator[int, None, PushPlan], now_ns: int) -> None:
        """Do the steps of the running search that this update can afford, and use the plan when it is complete.

        Args:
            running_plan: The search, which yields the cost of its next step in nodes.
            now_ns: Robot time.
        """
        node_budget = self._saved_node_budget + self._nodes_per_update
        while self._next_step_cost_nodes <= node_budget:
            node_budget -= self._next_step_cost_nodes
            self.expanded_nodes += self._next_step_cost_nodes
            try:
                self._next_step_cost_nodes = next(running_plan)
            except StopIteration as done:
                self._replace_plan(done.value, now_ns)
                return
        self._saved_node_budget = 0 if self.expanded_nodes else node_budget

    def _replace_plan(self, plan: PushPlan, now_ns: int) -> None:
        """Follow a new plan from now on, under a new path number."""
        self._plan = plan
        self._plan_time_ns = now_ns
        self._newest_path_id += 1
        self._published_path_id = self._newest_path_id
        if self._search_reason != MAP_CHANGED:
            # After a changed map they stay: a map that keeps changing must not hide that the body is stuck.
            self._recent_body_middles.clear()
        self._discard_running_plan()

    def _discard_running_plan(self) -> None:
        """End the search for a plan, whether it is complete or not."""
        self._running_plan = None
        self._search_reason = ""
        self._saved_node_budget = 0

    def _measure_movement_m(self, body_w: Floats, now_ns: int) -> float | None:
        """Add the position of the body, and return how far its middle has moved within STUCK_DURATION_S.

        Args:
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            now_ns: Robot time of the position.

        Returns:
            The distance in m, or None if positions of less than about STUCK_DURATION_S are known.
        """
        recent_middles = self._recent_body_middles
        middle_w = body_w.mean(axis=0)
        recent_middles.append((now_ns, middle_w))
        while now_ns - recent_middles[0][0] > STUCK_DURATION_S * 1e9:
            recent_middles.popleft()
        oldest_ns, oldest_w = recent_middles[0]
        # World models come at intervals, so positions over 80 % of the duration are enough.
        if now_ns - oldest_ns <= 0.8e9 * STUCK_DURATION_S:
            return None
        return float(np.hypot(*(middle_w - oldest_w)))

    def _find_replanning_reason(
        self,
        plan: PushPlan,
        body_w: Floats,
        world: WorldModel,
        moved_m: float | None,
        committed_m: float,
    ) -> str:
        """Return why another path is needed, or an empty string. It also starts and ends the backing out of a jam.

        Reasons are checked in order of urgency: the body is off its path, the path ends soon, the body is stuck, the
        goal has turned, the map has changed.

        Args:
            plan: The current plan.
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            world: The newest world model.
            moved_m: Movement of the body within the last STUCK_DURATION_S; None if it is not known yet.
            committed_m: Length of the path ahead of the head that a new path keeps.
        """
        now_ns = world.timestamp_ns
        head_s_m = plan.route.project_point(body_w[-1])
        if self._back_out_start_s_m is not None:
            return self._end_backing_out_if_done(self._back_out_start_s_m, head_s_m, now_ns)
        path_distance_m = statistics.median(
            _compute_distance_from_route_m(plan.route, point_w) for point_w in body_w[::10]
        )
        if path_distance_m > MAX_PATH_DISTANCE_M:
            return OFF_PATH
        if (
            self._failed_w
            and path_distance_m > MIN_SHIFT_M
            and now_ns - self._plan_time_ns > STUCK_DURATION_S * 1e9
        ):
            return SHIFTED
        if plan.route.length_m - head_s_m < MIN_PATH_AHEAD_M + committed_m - COMMITTED_M:
            return ENDS_SOON
        if moved_m is not None and moved_m < MAX_STUCK_DISTANCE_M:
            return self._handle_stall(plan.route, body_w, head_s_m, now_ns)
        if self._failed_w:
            return ""  # the way out of a jam comes first
        if self._has_goal_turned(body_w):
            return GOAL_TURNED
        if self._known_obstacle_grid is None and self._has_map_changed(body_w[-1], world.obstacles):
            return MAP_CHANGED
        return ""

    def _end_backing_out_if_done(self, from_s_m: float, head_s_m: float, now_ns: int) -> str:
        """End backing out when the head is far enough back, or after MAX_BACK_OUT_DURATION_S.

        Args:
            from_s_m: Arc length of the head at which backing out started.
            head_s_m: Current arc length of the head.
            now_ns: Robot time.

        Returns:
            BACKED_OUT if backing out has ended, which is a reason to plan; otherwise an empty text.
        """
        if from_s_m - head_s_m > BACK_OUT_DISTANCE_M or now_ns > self._back_out_end_ns:
            self._back_out_start_s_m = None
            return BACKED_OUT
        return ""

    def _has_goal_turned(self, body_w: Floats) -> bool:
        """Return whether the current path was planned for another direction."""
        if self._planned_heading_rad is None:
            return True
        heading_rad = compute_limited_heading_rad(body_w, self._goal.direction_w)
        return (
            abs(math.remainder(heading_rad - self._planned_heading_rad, math.tau))
            > MIN_GOAL_TURN_RAD
        )

    def _has_map_changed(self, head_w: Floats, obstacles: Sequence[KnownObstacle]) -> bool:
        """Return whether the map around the head differs from the one that the current path was planned on."""
        planned = self._planned_obstacle_shapes
        shapes = _describe_obstacle_shapes_near(head_w, obstacles)
        if len(planned) != len(shapes):
            return True
        return bool(len(shapes) and np.abs(planned - shapes).max() >= MAP_TOLERANCE_M)

    def _handle_stall(self, route: Route, body_w: Floats, head_s_m: float, now_ns: int) -> str:
        """Store the path on which the body is stuck as failed; every few stalls at one place, start to back out.

        Args:
            route: The current path.
            body_w: (n, 2) evenly spaced points along the body, tail to head, m.
            head_s_m: Arc length of the head on the path.
            now_ns: Robot time.

        Returns:
            STUCK as the reason to plan another path, or an empty text if the body backs out first.
        """
        position_along_goal_m = float(body_w.mean(axis=0) @ self._goal.direction_w)
        if (
            self._failed_w
            and abs(position_along_goal_m - self._first_stall_position_m)
            > FAILURE_MEMORY_DISTANCE_M
        ):
            self._failed_w.clear()
        if not self._failed_w:
            self._first_stall_position_m = position_along_goal_m
            self._stall_count = 0
        tail_s_m = route.project_point(body_w[0])
        self._failed_w.append(route.compute_positions_w(np.arange(tail_s_m, head_s_m + 0.1, 0.025)))
        self._failed_w = self._failed_w[-MAX_FAILED_PATHS:]
        self._stall_count += 1
        if self._stall_count % STALLS_PER_BACK_OUT:
            return STUCK
        self._back_out_start_s_m = head_s_m
        self._back_out_end_ns = now_ns + round(MAX_BACK_OUT_DURATION_S * 1e9)
        return ""

    def _update_tail_trail(self, tail_w: Floats) -> None:
        """Append the position of the tail, (2,), to its trail. A tail that moves back along the trail shortens it."""
        trail = self._trail_w
        if trail and np.hypot(*(trail[-1] - tail_w)) <= TRAIL_SPACING_M:
            return
        # Against the last step of the trail.
        is_going_back = len(trail) > 1 and float((tail_w - trail[-1]) @ (trail[-1] - trail[-2])) < 0
        if is_going_back:
            trail.pop()
        else:
            trail.append(tail_w)
        del trail[: -2 * MAX_TRAIL_POINTS]


def _describe_obstacle_shapes_near(head_w: Floats, obstacles: Sequence[KnownObstacle]) -> Floats:
    """Return center x, y, half sizes and rounding of the k obstacles near the head, (k, 5) in m."""
    outlines = ObstacleOutlines.from_obstacles(obstacles)
    offset = outlines.center_w - head_w
    is_near = np.hypot(offset[:, 0], offset[:, 1]) < MAP_RADIUS_M
    return np.column_stack([outlines.center_w, outlines.half_m, outlines.rounding_m])[is_near]


def _compute_distance_from_route_m(route: Route, point_w: Floats) -> float:
    return float(np.hypot(*(route.compute_positions_w(route.project_point(point_w)) - point_w)))
