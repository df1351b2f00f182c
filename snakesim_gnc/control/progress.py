"""Estimates the current position and speed of the body along its path.

A world model is some ticks old when it arrives. An alpha-beta filter tracks the arc length of the tail end, s, and its
speed, v, over the poses; between them s is extrapolated.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from snakesim_gnc.geometry.body_on_path import BodyOnPath
from snakesim_gnc.geometry.planar_body import JointAngleHistory, PlanarBody, get_pose_time_ns
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import Trajectory, WorldModel
from snakesim_hal.wire.quantities import from_zero

SpeedFilter = Annotated[float, from_zero(1, "s")]
# Iterations for a body that may have slid while its position was unknown.
RELOCALIZATION_ITERATIONS = 8


@dataclass(frozen=True)
class BodyLocation:
    """The body on its path at one tick."""

    # At this tick.
    body_on_path: BodyOnPath
    tail_s_m: float  # arc length of the tail end
    speed_m_s: float

    # At the time of the last pose.
    body_points_w: Floats  # (2, n_points) m: tail end, joints that bend, head end
    tail_s_at_pose_m: float  # arc length of the tail end

    is_new_world: bool  # this tick has another world model than the tick before
    may_have_jumped: bool  # the path is new, or the position was unknown in the tick before
    world: WorldModel
    trajectory: Trajectory


class PathProgress:
    """Tracks the body along the path with an alpha-beta filter over poses, each with the joint angles at its time.

    Only the yaw joints bend; all others count as straight. Between poses the arc length is extrapolated at the last
    speed, so that the result is always for the current. A world model that repeats a pose is not a new measurement:
    if it counted as one, the body would seem to be stationary.
    """

    def __init__(self, body: PlanarBody, *, speed_filter_s: float) -> None:
        """Prepare to track a body along a path, before any world model or path is known.

        Args:
            body: Lengths and indices of the robot's body.
            speed_filter_s: Time constant of the alpha-beta filter; 0 for no filtering.
        """
        self._planar_body = body
        self._speed_filter_s = speed_filter_s
        self._angle_history = JointAngleHistory()

        # The path.
        self._body_on_path: BodyOnPath | None = None
        self._path_id: int | None = None

        # The last world model and the last pose.
        self._last_world_tick: int | None = None
        # Time of the pose; None if the body's position is unknown.
        self._last_pose_ns: int | None = None
        self._body_points_w = np.empty((2, 0))

        # The state of the filter at that time.
        self._s_m = 0.0
        self._speed_m_s = 0.0

    def update(self, observation: Observation) -> BodyLocation | str:
        """Return the position and the speed of the body on the path at this tick. Call it in every tick.

        Between two poses the body is assumed to move on at its last speed.

        Args:
            observation: The inputs of this tick, with the newest world model and trajectory.

        Returns:
            The position, or a text with the reason why the position is unknown.
        """
        self._angle_history.add(observation.joints.timestamp_ns, observation.joints.angle_rad)
        world = observation.world
        trajectory = observation.trajectory
        if world is None:
            self._last_pose_ns = None
            return "no world model"
        if trajectory is None:
            self._last_pose_ns = None
            return "no trajectory"

        body_on_path = self._body_on_path
        is_new_path = body_on_path is None or trajectory.path_id != self._path_id
        if body_on_path is None or is_new_path:
            body_on_path = BodyOnPath(
                Route(trajectory.path_w), self._planar_body.segments_m, trajectory.rises
            )
            self._body_on_path = body_on_path
            self._path_id = trajectory.path_id

        last_pose_ns = self._last_pose_ns
        newest_pose_ns = self._localize_if_new(
            body_on_path, world, observation, is_new_path=is_new_path
        )
        elapsed_s = _convert_to_seconds(
            observation.joints.timestamp_ns - newest_pose_ns, observation
        )
        is_new_world = world.tick != self._last_world_tick
        self._last_world_tick = world.tick
        return BodyLocation(
            body_on_path=body_on_path,
            tail_s_m=self._s_m + self._speed_m_s * elapsed_s,
            speed_m_s=self._speed_m_s,
            body_points_w=self._body_points_w,
            tail_s_at_pose_m=self._s_m,
            is_new_world=is_new_world,
            may_have_jumped=is_new_path or last_pose_ns is None,
            world=world,
            trajectory=trajectory,
        )

    def _localize_if_new(
        self,
        body_on_path: BodyOnPath,
        world: WorldModel,
        observation: Observation,
        *,
        is_new_path: bool,
    ) -> int:
        """Localize the body on the path if the path or the pose is new since the last tick.

        Args:
            body_on_path: The body on the current path.
            world: The newest world model, with the pose.
            observation: The inputs of this tick.
            is_new_path: Whether the path differs from that of the last tick.

        Returns:
            Time of the newest pose in ns.
        """
        last_pose_ns = self._last_pose_ns
        pose_ns = get_pose_time_ns(world)
        newest_pose_ns = pose_ns
        if last_pose_ns is None or pose_ns > last_pose_ns:
            self._body_points_w = self._planar_body.compute_body_points_w(
                world, self._angle_history.find_nearest(pose_ns)
            )
        else:
            newest_pose_ns = last_pose_ns
        self._last_pose_ns = newest_pose_ns

        if is_new_path:
            # The body is as fast on the new path as it was on the old one.
            self._s_m = body_on_path.find_tail_s_m(self._body_points_w)
        elif last_pose_ns is None:
            self._s_m = body_on_path.refine_tail_s_m(
                self._body_points_w, self._s_m, step_count=RELOCALIZATION_ITERATIONS
            )
            self._speed_m_s = 0.0
        elif pose_ns > last_pose_ns:
            self._update_filter(
                body_on_path,
                max(_convert_to_seconds(pose_ns - last_pose_ns, observation), observation.period_s),
            )
        return newest_pose_ns

    def _update_filter(self, body_on_path: BodyOnPath, dt_s: float) -> None:
        """Update the arc length s and the speed v with a new pose, by a critically damped alpha-beta filter.

        With the time T between two poses, the time constant tau = `speed_filter_s` and k = exp(-T / tau):

            s_predicted = s + v T
            r = s_measured - s_predicted
            s = s_predicted + (1 - k^2) r
            v = v + (1 - k)^2 r / T
        """
        predicted_s_m = self._s_m + self._speed_m_s * dt_s
        residual_m = (
            body_on_path.refine_tail_s_m(self._body_points_w, predicted_s_m, step_count=1)
            - predicted_s_m
        )
        k = 0.0
        if self._speed_filter_s > 0:
            k = float(np.exp(-dt_s / self._speed_filter_s))
        self._s_m = predicted_s_m + (1 - k * k) * residual_m
        self._speed_m_s += (1 - k) ** 2 * residual_m / dt_s


def _convert_to_seconds(elapsed_ns: int, observation: Observation) -> float:
    """Convert a time in ns to s, as a multiple of the control period.

    Computed in this way, the result has the same bits on every machine.
    """
    return elapsed_ns / round(observation.period_s * 1e9) * observation.period_s
