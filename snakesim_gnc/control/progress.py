"""Estimates the present position and speed of the body along its path.

A world model is some ticks old when it arrives. An alpha-beta filter tracks the arc length of the tail end, s, and its
speed, v, over the poses; between them s is extrapolated.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from snakesim_gnc.geometry.body_on_path import BodyOnPath
from snakesim_gnc.geometry.planar_body import PlanarBody, RecentAngles, pose_time_ns
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Trajectory, World
from snakesim_hal.wire.quantities import from_zero

SpeedFilter = Annotated[float, from_zero(1, "s")]
RELOCALIZE_STEPS = 8  # iterations for a body that may have slid while its position was unknown


@dataclass(frozen=True)
class Located:
    """The body on its path at one tick."""

    # At this tick.
    on_path: BodyOnPath
    tail_s_m: float  # arc length of the tail end
    speed_m_s: float

    # At the time of the last pose.
    nodes_w: Floats  # (2, n_nodes) m, tail to head
    measured_s_m: float  # arc length of the tail end

    fresh: bool  # the world model is a new one
    restarted: bool  # on a new path, or localized again after it was unknown: the position may have jumped
    world: World
    trajectory: Trajectory


class PathProgress:
    """Tracks the body along the path with an alpha-beta filter over poses, each with the joint angles at its time.

    Only the yaw joints bend; all others count as straight. Between poses the arc length is extrapolated at the last
    speed, so that the result is always for the present. A world model that repeats a pose is not a new measurement:
    if it counted as one, the body would seem to be stationary.
    """

    def __init__(self, body: PlanarBody, *, speed_filter_s: float) -> None:
        """Prepare to track a body along a path, before any world model or path is known.

        Args:
            body: lengths and indices of the robot's body.
            speed_filter_s: time constant of the filter; 0 takes every measurement as it is.
        """
        self._planar = body
        self._speed_filter_s = speed_filter_s
        self._angles = RecentAngles()

        # The path.
        self._body: BodyOnPath | None = None
        self._path_id: int | None = None

        # The last world model and the last pose.
        self._world_tick: int | None = None
        self._measured_ns: int | None = None  # time of the pose; None: the body's position is unknown
        self._nodes = np.empty((2, 0))

        # The state of the filter at that time.
        self._s_m = 0.0
        self._speed_m_s = 0.0

    def update(self, observation: Observation) -> Located | str:
        """Return the position and the speed of the body on the path at this tick. Call it in every tick.

        Between two poses the body is assumed to move on at its last speed.

        Args:
            observation: the inputs of this tick, with the newest world model and trajectory.

        Returns:
            The position, or the reason as text why it is unknown.
        """
        self._angles.add(observation.joints.timestamp_ns, observation.joints.angle_rad)
        world = observation.world
        trajectory = observation.trajectory
        if world is None:
            self._measured_ns = None
            return "no world model"
        if trajectory is None:
            self._measured_ns = None
            return "no trajectory"

        body = self._body
        is_new_path = body is None or trajectory.path_id != self._path_id
        if body is None or is_new_path:
            body = BodyOnPath(Route(trajectory.path_w), self._planar.segments_m, trajectory.rises)
            self._body = body
            self._path_id = trajectory.path_id

        last_measured_ns = self._measured_ns
        measured_ns = self._measure(body, world, observation, is_new_path=is_new_path)
        elapsed_s = _seconds(observation.joints.timestamp_ns - measured_ns, observation)
        is_new_world = world.tick != self._world_tick
        self._world_tick = world.tick
        return Located(
            on_path=body,
            tail_s_m=self._s_m + self._speed_m_s * elapsed_s,
            speed_m_s=self._speed_m_s,
            nodes_w=self._nodes,
            measured_s_m=self._s_m,
            fresh=is_new_world,
            restarted=is_new_path or last_measured_ns is None,
            world=world,
            trajectory=trajectory,
        )

    def _measure(self, body: BodyOnPath, world: World, observation: Observation, *, is_new_path: bool) -> int:
        """Localize the body on the path if the path or the pose is new since the last tick.

        Args:
            body: the body on the path.
            world: the newest world model, with the pose.
            observation: the inputs of this tick.
            is_new_path: whether the path differs from that of the last tick.

        Returns:
            Time of the newest pose in ns.
        """
        last_ns = self._measured_ns
        pose_ns = pose_time_ns(world)
        measured_ns = pose_ns
        if last_ns is None or pose_ns > last_ns:
            self._nodes = self._planar.nodes_w(world, self._angles.nearest_to(pose_ns))
        else:
            measured_ns = last_ns
        self._measured_ns = measured_ns

        if is_new_path:
            # The body is as fast on the new path as it was on the old one.
            self._s_m = body.find_tail_s_m(self._nodes)
        elif last_ns is None:
            self._s_m = body.refine_tail_s_m(self._nodes, self._s_m, steps=RELOCALIZE_STEPS)
            self._speed_m_s = 0.0
        elif pose_ns > last_ns:
            self._filter(body, max(_seconds(pose_ns - last_ns, observation), observation.period_s))
        return measured_ns

    def _filter(self, body: BodyOnPath, dt_s: float) -> None:
        """Update the arc length s and the speed v with a new pose, by a critically damped alpha-beta filter.

        With the time T between two poses, the time constant tau = `speed_filter_s` and k = exp(-T / tau):

            s_predicted = s + v T
            r = s_measured - s_predicted
            s = s_predicted + (1 - k^2) r
            v = v + (1 - k)^2 r / T
        """
        predicted_s_m = self._s_m + self._speed_m_s * dt_s
        residual_m = body.refine_tail_s_m(self._nodes, predicted_s_m, steps=1) - predicted_s_m
        k = 0.0
        if self._speed_filter_s > 0:
            k = float(np.exp(-dt_s / self._speed_filter_s))
        self._s_m = predicted_s_m + (1 - k * k) * residual_m
        self._speed_m_s += (1 - k) ** 2 * residual_m / dt_s


def _seconds(elapsed_ns: int, observation: Observation) -> float:
    """Convert a time to seconds as a multiple of the period, which gives the same bits on every machine."""
    return elapsed_ns / round(observation.period_s * 1e9) * observation.period_s
