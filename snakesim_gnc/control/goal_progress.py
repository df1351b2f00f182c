"""Measures how far the body has advanced towards its goal, from the pose sensor and the joints alone."""

import math
from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Task
from snakesim_hal.model.kinematics import NodeFinder
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import Description, JointState, Pose


class GoalProgress:
    """The advance of one episode, as a run's summary counts it: towards the goal, or else along the first heading.

    For a goal with a heading, and without a goal, the advance is the displacement of the center of mass, c, along the
    direction d: `(c - c_0) . d`. For waypoints it is the decrease of the way from the head through all points left.
    """

    def __init__(self, robot: Description, task: Task) -> None:
        """Prepare to measure the advance of a body from the start pose of its task.

        Args:
            robot: description of the robot.
            task: start pose and goal.
        """
        self._locator = BodyLocator(robot)

        # The goal.
        self._goal = task.goal
        self._points_m: list[tuple[float, float]] = []
        if isinstance(self._goal, WaypointGoal):
            self._points_m = self._goal.points_m
        self._next_point = 0
        self._has_started = False

        # Results.
        # Position and quaternion of the tail end.
        self.pose: tuple[Sequence[float], Sequence[float]] = (task.start_position_w, task.start_wxyz)
        self.along_m = 0.0  # advance towards the goal since the start
        self.bearing_rad = 0.0  # of the goal, from the heading of the body
        self.goal_m: float | None = None  # distance of the goal from the start; None: there is no goal

    def update(self, joints: JointState, pose: Pose | None) -> None:
        """Measure the advance with the newest samples. Before the first pose the scenario's start is used."""
        if pose is not None:
            self.pose = pose.position_w, pose.orientation_wxyz
        position_w, wxyz = self.pose
        nodes_w, centers_w = self._locator.locate(np.array([[*position_w, *wxyz]]), np.array([joints.angle_rad]))
        self.follow(nodes_w[0], centers_w[0])

    def follow(self, nodes_w: Floats, center_w: Floats) -> None:
        """Update the advance towards the goal and the bearing of the goal with a new position of the body.

        The first call also sets the start of the advance.

        Args:
            nodes_w: (joints + 2, 3) tail end, joints and head end in the world, m.
            center_w: (2,) center of mass on the ground, m.
        """
        self._nodes_w = nodes_w
        self.center_w = center_w
        self._head_w = nodes_w[-1, :2]
        forward_x, forward_y = (self._head_w - nodes_w[0, :2]).tolist()
        self._heading_rad = math.atan2(forward_y, forward_x)
        if not self._has_started:
            self._has_started = True
            self._start()
        # The waypoint that was next until now is the goal of the bearing, also if the head has just reached it.
        self.bearing_rad = self._goal_direction_rad() - self._heading_rad
        self.along_m = self._measure_advance_m()

    @property
    def height_m(self) -> float:
        """Mean height of the links' origins."""
        return float(self._nodes_w[:-1, 2].mean())

    @property
    def left_m(self) -> float:
        """Distance that is left to the goal; 0 without a goal."""
        if self.goal_m is None:
            return 0.0
        return max(self.goal_m - self.along_m, 0.0)

    @property
    def reached(self) -> bool:
        """Whether there is a goal, and it has been reached."""
        return self.goal_m is not None and self.along_m >= self.goal_m

    def _start(self) -> None:
        """Fix where the advance begins, its direction, and how far the goal is."""
        self._start_w = self.center_w
        direction_rad = self._heading_rad
        match self._goal:
            case HeadingGoal():
                direction_rad = self._goal.heading_rad
                self.goal_m = self._goal.distance_m
            case WaypointGoal():
                self.goal_m = self._measure_way_left_m()
            case None:
                center_to_head_w = self._head_w - self.center_w
                direction_rad = math.atan2(center_to_head_w[1], center_to_head_w[0])
        self._direction_rad = direction_rad
        self._direction_w = np.array([math.cos(direction_rad), math.sin(direction_rad)])

    def _goal_direction_rad(self) -> float:
        """Return the direction in the world of the next waypoint from the head, or else that of the goal."""
        if self._next_point < len(self._points_m):
            x, y = np.subtract(self._points_m[self._next_point], self._head_w)
            return math.atan2(y, x)
        return self._direction_rad

    def _measure_advance_m(self) -> float:
        if not isinstance(self._goal, WaypointGoal):
            return float((self.center_w - self._start_w) @ self._direction_w)
        while self._next_point < len(self._points_m) and self._distance_to_next_m() <= self._goal.within_m:
            self._next_point += 1
        return (self.goal_m or 0.0) - self._measure_way_left_m()

    def _measure_way_left_m(self) -> float:
        """Return the length of the way from the head through all waypoints that it has not reached yet."""
        points_m = self._points_m[self._next_point :]
        legs_m = np.diff(np.vstack([self._head_w, *points_m]), axis=0)
        return float(np.hypot(*legs_m.T).sum())

    def _distance_to_next_m(self) -> float:
        return float(np.hypot(*np.subtract(self._points_m[self._next_point], self._head_w)))


class BodyLocator:
    """Computes where bodies are, for any number of robots with equal links."""

    def __init__(self, robot: Description) -> None:
        """Read the links of a robot."""
        self._nodes = NodeFinder(robot)
        masses_kg = np.array([link.mass_kg for link in robot.links])
        self._mass_ratios = masses_kg / masses_kg.sum()  # (n_links,), of the whole

    def locate(self, poses: Floats, angles_rad: Floats) -> tuple[Floats, Floats]:
        """Locate bodies.

        Args:
            poses: (n, 7), position in m and quaternion wxyz of the tail ends.
            angles_rad: (n, joints), tail to head.

        Returns:
            Tail ends, joints and head ends, (n, joints + 2, 3); and centers of mass on the ground, (n, 2); in m.
        """
        nodes_w = self._nodes.find(poses[:, :3], poses[:, 3:], angles_rad)
        # The mass of every link is at its middle. The last link reaches from its origin to the head.
        origins_w = nodes_w[:, :-1, :2]
        middles_w = 0.5 * (origins_w[:, 1:] + origins_w[:, :-1])
        last_moments_w = self._mass_ratios[-1] * 0.5 * (origins_w[:, -1] + nodes_w[:, -1, :2])
        return nodes_w, self._mass_ratios[:-1] @ middles_w + last_moments_w
