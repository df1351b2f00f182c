"""Directional control of planar gaits: how much the whole body bends so that it converges to the path.

Source: P. Liljebäck, K. Y. Pettersen, Ø. Stavdahl, J. T. Gravdahl, "Snake Robots: Modelling, Mechatronics, and
Control", Springer 2013. The heading of the robot is the mean of the headings of its links,

    theta_bar = (1 / N) sum_i theta_i.

Line-of-sight guidance gives the desired heading from the distance p_y of the robot from the path, to the left, and a
look-ahead distance Delta,

    theta_ref = heading of the path - arctan(p_y / Delta).

On a straight path that is the direction to the point at the distance Delta ahead on the path. This point is used on
curved paths as well, because a planned path begins with the shape of the body.

Every joint gets an offset in proportion to the error. Here the offset is a bend of the whole body, so that it does not
depend on the number of joints:

    bend = k_theta (theta_ref - theta_bar),

low-pass filtered over a period of the gait, because the mean heading swings with the wave.
"""

import math
from typing import Annotated

import numpy as np

from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.controller import Observation
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import above, from_zero

MIN_MEAN_RESULTANT = 0.2  # resultant of the headings below which they have no mean direction

SteeringGain = Annotated[float, from_zero(5, "1")]
LookAhead = Annotated[float, above(10, "body lengths")]
MaxBend = Annotated[float, from_zero(6, "rad")]


class HeadingControl:
    """Computes the bend of one robot."""

    def __init__(
        self,
        robot: RobotDescription,
        *,
        k_theta: float,
        look_ahead: float,
        max_bend_rad: float,
        time_constant_s: float,
    ) -> None:
        """Create a heading control without a path, whose bend is zero.

        Args:
            robot: Description of the robot.
            k_theta: Gain: bend of the whole body for each radian of heading error; 0 switches the control off.
            look_ahead: Look-ahead distance Delta in body lengths.
            max_bend_rad: Maximum bend of the whole body to either side.
            time_constant_s: Time constant of the low-pass filter.
        """
        self._body = PlanarBody(robot)
        self._k_theta = k_theta
        self._look_ahead_m = look_ahead * self._body.length_m
        self._max_bend_rad = max_bend_rad
        self._time_constant_s = time_constant_s
        self._bend_rad = 0.0
        self._route: Route | None = None
        self._path_id: int | None = None
        self.error_rad = 0.0  # theta_ref - theta_bar of the last tick; 0.0 if unknown

    def compute_bend_rad(self, observation: Observation) -> float:
        """Update the low-pass filtered bend of the whole body, and return it in rad, left positive.

        Call it once in every tick.
        """
        self.error_rad = self._compute_error_rad(observation)
        desired_rad = self._k_theta * self.error_rad
        desired_rad = min(max(desired_rad, -self._max_bend_rad), self._max_bend_rad)
        alpha = 1.0 - math.exp(-observation.period_s / self._time_constant_s)
        self._bend_rad += alpha * (desired_rad - self._bend_rad)
        return self._bend_rad

    def _compute_error_rad(self, observation: Observation) -> float:
        """Return the heading error theta_ref - theta_bar in rad.

        It is 0.0 without a world model or a path, and if the headings of the links have no mean direction.
        """
        world = observation.world
        trajectory = observation.trajectory
        if self._k_theta == 0.0 or world is None or trajectory is None:
            return 0.0
        if self._route is None or trajectory.path_id != self._path_id:
            self._route = Route(trajectory.path_w)
            self._path_id = trajectory.path_id

        # (2, n_points).
        body_points_w = self._body.compute_body_points_w(world, observation.joints.angle_rad)
        link_vectors_w = np.diff(body_points_w, axis=1)
        headings_rad = np.arctan2(link_vectors_w[1], link_vectors_w[0])
        resultant = np.exp(1j * headings_rad).mean()
        if abs(resultant) < MIN_MEAN_RESULTANT:
            return 0.0
        theta_bar = float(np.angle(resultant))

        center_w = body_points_w.mean(axis=1)
        s_m = self._route.project_point(center_w)
        aim_x, aim_y = self._route.compute_point(s_m + self._look_ahead_m)
        theta_ref = math.atan2(aim_y - center_w[1], aim_x - center_w[0])
        return math.remainder(theta_ref - theta_bar, math.tau)
