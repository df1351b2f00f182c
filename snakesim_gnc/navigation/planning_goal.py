"""Where a planner's goal is, in which direction, and whether the body has reached it. Pure except for its own state."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal

# A body that was at its goal continues only if it is farther away than this.
REACHED_HYSTERESIS_M = 0.01


class PlanningGoal:
    """Follows a mission's goal, or a heading that replaces it."""

    def __init__(self, goal: HeadingGoal | WaypointGoal, body_length_m: float) -> None:
        self._goal = goal
        self._body_length_m = body_length_m
        self._start_w: Floats | None = None  # middle of the body at the first update
        self._next_waypoint = 0
        self.direction_w = np.zeros(2)  # unit vector from the body to the goal
        self.position_w = np.zeros(2)  # where the head shall go
        self.is_reached = False

    def update(self, body_points_w: Floats, heading_w_rad: float | None) -> None:
        """Compute direction and position for a body (n, 2), tail to head. heading_w_rad: replaces the mission's goal.

        With a heading the goal is always one body length ahead, and never reached.
        """
        if heading_w_rad is not None:
            self.direction_w = np.array([np.cos(heading_w_rad), np.sin(heading_w_rad)])
            self.position_w = body_points_w[-1] + self._body_length_m * self.direction_w
            self.is_reached = False
        elif isinstance(self._goal, HeadingGoal):
            self._update_from_heading(self._goal, body_points_w)
        else:
            self._update_from_waypoints(self._goal, body_points_w)

    def _update_from_heading(self, goal: HeadingGoal, body_points_w: Floats) -> None:
        """Update direction, position and `is_reached` of a goal at a distance from the start, along a heading."""
        direction_w = np.array([np.cos(goal.heading_rad), np.sin(goal.heading_rad)])
        middle_w = body_points_w.mean(axis=0)
        if self._start_w is None:
            self._start_w = middle_w
            self.position_w = middle_w + (goal.distance_m + self._body_length_m) * direction_w
        remaining_m = goal.distance_m - float((middle_w - self._start_w) @ direction_w)
        self.is_reached = remaining_m <= (REACHED_HYSTERESIS_M if self.is_reached else 0.0)
        self.direction_w = direction_w

    def _update_from_waypoints(self, goal: WaypointGoal, body_points_w: Floats) -> None:
        """Select the next waypoint that the head has not reached, and update direction and position of the goal."""
        waypoints_w = np.array(goal.points_m)
        head_w = body_points_w[-1]
        while np.hypot(*(waypoints_w[self._next_waypoint] - head_w)) < goal.within_m:
            if self._next_waypoint == len(waypoints_w) - 1:
                self.is_reached = True
                break
            self._next_waypoint += 1
        self.position_w = waypoints_w[self._next_waypoint]
        head_to_goal = self.position_w - head_w
        self.direction_w = head_to_goal / max(float(np.hypot(*head_to_goal)), 1e-9)
