"""Where the body is, and how far it has come: from the pose sensor and the joints, as a robot knows it."""

import math

import numpy as np

from snakesim_gnc.control.controller import Task
from snakesim_hal.model.kinematics import nodes_w
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import Description, JointState, Pose


class Progress:
    """The advance of one episode, as a run's summary counts it: towards the goal, or else along the first heading."""

    def __init__(self, robot: Description, task: Task) -> None:
        self._robot = robot
        masses = np.array([link.mass_kg for link in robot.links])
        self._shares = masses / masses.sum()
        self._goal = task.goal
        self._points_m = self._goal.points_m if isinstance(self._goal, WaypointGoal) else []
        self._next = 0
        self._begun = False
        self.pose = task.start_position_w, task.start_wxyz  # position and quaternion of the tail end
        self.along_m = 0.0  # towards the goal, since the start
        self.goal_m: float | None = None  # how far the goal is from the start; None: there is none

    def update(self, joints: JointState, pose: Pose | None) -> None:
        """Take the newest samples. Before the first pose the scenario's start is used."""
        if pose is not None:
            self.pose = pose.position_w, pose.orientation_wxyz
        position_w, wxyz = self.pose
        nodes = nodes_w(self._robot, position_w, wxyz, joints.angle_rad)
        origins, self._head_w = nodes[:-1, :2], nodes[-1, :2]
        halves = 0.5 * (origins[1:] + origins[:-1])
        self.center_w = self._shares[:-1] @ halves + self._shares[-1] * 0.5 * (origins[-1] + self._head_w)
        self.height_m = float(nodes[:-1, 2].mean())
        forward = self._head_w - origins[0]
        self._heading_rad = math.atan2(forward[1], forward[0])
        if not self._begun:
            self._begin()
        before = self._goal_bearing()
        self.bearing_rad = before - self._heading_rad
        self.along_m = self._along()

    @property
    def left_m(self) -> float:
        """To the goal; 0 without one."""
        return 0.0 if self.goal_m is None else max(self.goal_m - self.along_m, 0.0)

    @property
    def reached(self) -> bool:
        """Whether there is a goal, and it has been reached."""
        return self.goal_m is not None and self.along_m >= self.goal_m

    def _begin(self) -> None:
        self._begun = True
        self._origin_w = self.center_w
        heading_rad = self._heading_rad
        match self._goal:
            case HeadingGoal():
                heading_rad, self.goal_m = self._goal.heading_rad, self._goal.distance_m
            case WaypointGoal():
                self.goal_m = self._to_go()
            case None:
                to_head = self._head_w - self.center_w
                heading_rad = math.atan2(to_head[1], to_head[0])
        self._direction_rad = heading_rad
        self._forward = np.array([math.cos(heading_rad), math.sin(heading_rad)])

    def _goal_bearing(self) -> float:
        """Direction of the goal in the world; of the next point while there is one."""
        if self._next < len(self._points_m):
            x, y = np.subtract(self._points_m[self._next], self._head_w)
            return math.atan2(y, x)
        return self._direction_rad

    def _along(self) -> float:
        if not isinstance(self._goal, WaypointGoal):
            return float((self.center_w - self._origin_w) @ self._forward)
        while self._next < len(self._points_m) and self._head_to(self._next) <= self._goal.within_m:
            self._next += 1
        return (self.goal_m or 0.0) - self._to_go()

    def _to_go(self) -> float:
        points = self._points_m[self._next :]
        legs = np.diff(np.vstack([self._head_w, *points]), axis=0)
        return float(np.hypot(*legs.T).sum())

    def _head_to(self, point: int) -> float:
        return float(np.hypot(*np.subtract(self._points_m[point], self._head_w)))
