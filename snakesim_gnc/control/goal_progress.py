"""Measures how far the body has advanced towards its goal, from the pose sensor and the joints alone."""

import math
from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Task
from snakesim_hal.model.geometry.kinematics import ForwardKinematics
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import JointState, Pose, RobotDescription


class GoalProgress:
    """The advance of one episode, as a run's summary counts it: towards the goal, or else along the first heading.

    For a goal with a heading, and without a goal, the advance is the displacement of the center of mass, c, along the
    direction d: `(c - c_0) . d`. For waypoints it is the decrease of the way from the head through all points left.
    """

    def __init__(self, robot: RobotDescription, task: Task) -> None:
        """Prepare to measure the advance of a body from the start pose of its task.

        Args:
            robot: Description of the robot.
            task: Start pose and goal.
        """
        self._locator = BodyLocator(robot)

        # The goal.
        self._goal = task.goal
        self._waypoints_m: list[tuple[float, float]] = []
        if isinstance(self._goal, WaypointGoal):
            self._waypoints_m = self._goal.points_m
        self._next_waypoint = 0
        self._has_started = False

        # Results.
        # Position and quaternion of the tail end.
        self.pose: tuple[Sequence[float], Sequence[float]] = (
            task.start_position_w,
            task.start_wxyz,
        )
        self.advance_m = 0.0  # advance towards the goal since the start
        # Direction of the goal relative to the heading of the body, left positive.
        self.goal_bearing_rad = 0.0
        # Distance of the goal from the start; None without a goal.
        self.goal_distance_m: float | None = None

    def update(self, joints: JointState, pose: Pose | None) -> None:
        """Update advance and goal bearing with the newest samples.

        Args:
            joints: The newest joint state.
            pose: The newest pose of the tail end; None to use the pose before, which is the start pose at first.
        """
        if pose is not None:
            self.pose = pose.position_w, pose.orientation_wxyz
        position_w, wxyz = self.pose
        body_points_w, centers_w = self._locator.compute_body_positions(
            np.array([[*position_w, *wxyz]]), np.array([joints.angle_rad])
        )
        self.update_from_body(body_points_w[0], centers_w[0])

    def update_from_body(self, body_points_w: Floats, center_w: Floats) -> None:
        """Update the advance towards the goal and the bearing of the goal with a new position of the body.

        The first call also sets the position from which the advance is measured.

        Args:
            body_points_w: (joints + 2, 3) tail end, joints and head end in the world, m.
            center_w: (2,) center of mass on the ground, m.
        """
        self._body_points_w = body_points_w
        self.center_w = center_w
        self._head_w = body_points_w[-1, :2]
        forward_x, forward_y = (self._head_w - body_points_w[0, :2]).tolist()
        self._heading_rad = math.atan2(forward_y, forward_x)
        if not self._has_started:
            self._has_started = True
            self._set_start()
        # The waypoint that was next until now is the goal of the bearing, also if the head has just reached it.
        self.goal_bearing_rad = self._compute_goal_direction_rad() - self._heading_rad
        self.advance_m = self._measure_advance_m()

    @property
    def mean_height_m(self) -> float:
        """Mean height of the links' origins."""
        return float(self._body_points_w[:-1, 2].mean())

    @property
    def remaining_distance_m(self) -> float:
        """Distance that is left to the goal; 0 without a goal."""
        if self.goal_distance_m is None:
            return 0.0
        return max(self.goal_distance_m - self.advance_m, 0.0)

    @property
    def is_goal_reached(self) -> bool:
        """Whether there is a goal, and it has been reached."""
        return self.goal_distance_m is not None and self.advance_m >= self.goal_distance_m

    def _set_start(self) -> None:
        """Store the start of the advance, its direction, and the distance of the goal from the start."""
        self._start_w = self.center_w
        direction_rad = self._heading_rad
        match self._goal:
            case HeadingGoal():
                direction_rad = self._goal.heading_rad
                self.goal_distance_m = self._goal.distance_m
            case WaypointGoal():
                self.goal_distance_m = self._measure_remaining_route_m()
            case None:
                center_to_head_w = self._head_w - self.center_w
                direction_rad = math.atan2(center_to_head_w[1], center_to_head_w[0])
        self._direction_rad = direction_rad
        self._direction_w = np.array([math.cos(direction_rad), math.sin(direction_rad)])

    def _compute_goal_direction_rad(self) -> float:
        """Return the heading in the world from the head to the next waypoint, or else that of the goal."""
        if self._next_waypoint < len(self._waypoints_m):
            x, y = np.subtract(self._waypoints_m[self._next_waypoint], self._head_w)
            return math.atan2(y, x)
        return self._direction_rad

    def _measure_advance_m(self) -> float:
        """Return the advance towards the goal since the start.

        With waypoints, those that the head has reached are skipped from now on.
        """
        if not isinstance(self._goal, WaypointGoal):
            return float((self.center_w - self._start_w) @ self._direction_w)
        while (
            self._next_waypoint < len(self._waypoints_m)
            and self._measure_distance_to_next_waypoint_m() <= self._goal.within_m
        ):
            self._next_waypoint += 1
        return (self.goal_distance_m or 0.0) - self._measure_remaining_route_m()

    def _measure_remaining_route_m(self) -> float:
        """Return the length of the polyline from the head through all waypoints that it has not reached yet."""
        points_m = self._waypoints_m[self._next_waypoint :]
        legs_m = np.diff(np.vstack([self._head_w, *points_m]), axis=0)
        return float(np.hypot(*legs_m.T).sum())

    def _measure_distance_to_next_waypoint_m(self) -> float:
        return float(np.hypot(*np.subtract(self._waypoints_m[self._next_waypoint], self._head_w)))


class BodyLocator:
    """Computes body points and centers of mass, for any number of robots with equal links."""

    def __init__(self, robot: RobotDescription) -> None:
        """Read the links of a robot."""
        self._nodes = ForwardKinematics(robot)
        masses_kg = np.array([link.mass_kg for link in robot.links])
        self._mass_fractions = masses_kg / masses_kg.sum()  # (n_links,), of the whole

    def compute_body_positions(self, poses: Floats, angles_rad: Floats) -> tuple[Floats, Floats]:
        """Compute the body points and the centers of mass of n robots.

        Args:
            poses: (n, 7) positions in m and quaternions wxyz of the tail ends.
            angles_rad: (n, joints) joint angles, tail to head.

        Returns:
            Tail ends, joints and head ends, (n, joints + 2, 3); and centers of mass on the ground, (n, 2); in m.
        """
        body_points_w = self._nodes.compute_body_points_w(poses[:, :3], poses[:, 3:], angles_rad)
        # The mass of every link is at its middle. The last link reaches from its origin to the head.
        origins_w = body_points_w[:, :-1, :2]
        middles_w = 0.5 * (origins_w[:, 1:] + origins_w[:, :-1])
        last_moments_w = (
            self._mass_fractions[-1] * 0.5 * (origins_w[:, -1] + body_points_w[:, -1, :2])
        )
        return body_points_w, self._mass_fractions[:-1] @ middles_w + last_moments_w
