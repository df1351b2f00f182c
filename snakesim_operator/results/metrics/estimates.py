"""Reports what guidance estimated instead of measured in a run, and the error of dead reckoning."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_body_points_w
from snakesim_hal.wire.messages import WorldModel
from snakesim_operator.results.run_log import RunRecord


@dataclass(frozen=True)
class EstimateMetrics:
    """Sources of the last world model, and errors of dead reckoning. A value is None if it is unknown."""

    pose_from: str | None = None
    contacts_from: str | None = None
    dead_reckoned_distance_m: float | None = None
    dead_reckoning_error_m: float | None = None

    @staticmethod
    def from_run(record: RunRecord) -> "EstimateMetrics":
        """Determine the sources of the estimates of guidance, and the error of its dead reckoning.

        Args:
            record: The recorded run, with the world states that guidance published.

        Returns:
            The estimates. Distance and error are None if no pose was estimated by dead reckoning.
        """
        if not record.worlds or len(record.time_s) == 0:
            return EstimateMetrics()
        last_world = record.worlds[-1]
        dead_reckoned_worlds = [
            world for world in record.worlds if world.pose_from == "dead_reckoning"
        ]
        known_errors_m: list[float] = []
        for world in dead_reckoned_worlds:
            error_m = _measure_position_error_m(record, world)
            if error_m is not None:
                known_errors_m.append(error_m)
        distance_m = None
        if len(dead_reckoned_worlds) > 1:
            distance_m = _measure_estimated_advance_m(
                record, dead_reckoned_worlds[0], dead_reckoned_worlds[-1]
            )
        return EstimateMetrics(
            pose_from=last_world.pose_from,
            contacts_from=last_world.contacts_from,
            dead_reckoned_distance_m=distance_m,
            dead_reckoning_error_m=max(known_errors_m, default=None),
        )

    def describe(self) -> list[str]:
        """Describe each estimate that replaced a measurement by a phrase."""
        phrases: list[str] = []
        if self.pose_from == "dead_reckoning":
            phrase = "the pose is estimated by dead reckoning"
            if self.dead_reckoned_distance_m is not None:
                phrase += f", {self.dead_reckoned_distance_m:.3f} m far"
            if self.dead_reckoning_error_m is not None:
                phrase += f", at most {100 * self.dead_reckoning_error_m:.1f} cm off"
            phrases.append(phrase)
        if self.contacts_from == "joint_torques":
            phrases.append("contacts are estimated from joint torques")
        return phrases


def _measure_position_error_m(record: RunRecord, world: WorldModel) -> float | None:
    """Return the horizontal distance from the estimated to the measured position in m; None if none was measured."""
    row = record.find_nearest_row(world.timestamp_ns * 1e-9)
    if not record.has_pose[row]:
        return None
    x, y, _ = record.position_w_m[row].tolist()
    return math.dist((x, y), world.base_position_w[:2])


def _measure_estimated_advance_m(
    record: RunRecord, first: WorldModel, last: WorldModel
) -> float | None:
    """Return the advance along the route between two estimated poses, in m.

    Without a route, the displacement of the mean of the body points is used. Returns None if an angle is unknown.
    """
    first_points_w = _find_estimated_body_points_w(record, first)
    last_points_w = _find_estimated_body_points_w(record, last)
    if not (np.isfinite(first_points_w).all() and np.isfinite(last_points_w).all()):
        return None
    route = record.route
    if route is None:
        return float(np.hypot(*(last_points_w - first_points_w).mean(axis=0)))
    first_position_m = float(np.mean([route.project_point(point_w) for point_w in first_points_w]))
    last_position_m = float(np.mean([route.project_point(point_w) for point_w in last_points_w]))
    return last_position_m - first_position_m


def _find_estimated_body_points_w(record: RunRecord, world: WorldModel) -> Floats:
    """Compute the horizontal positions of tail end, joints and head end at the estimated pose, (joints + 2, 2)."""
    angles_rad = record.angle_rad[record.find_nearest_row(world.timestamp_ns * 1e-9)]
    return compute_body_points_w(
        record.description, world.base_position_w, world.base_orientation_wxyz, angles_rad
    )[:, :2]
