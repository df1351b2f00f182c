"""What guidance did not measure in a run but estimate, and how far that was from what was measured beside it."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import find_nodes_w
from snakesim_hal.wire.messages import World
from snakesim_operator.results.run_log import RunRecord


@dataclass(frozen=True)
class Estimates:
    """Sources of the last world model, and errors of dead reckoning. None: unknown, or nothing to compare with."""

    pose_from: str | None = None
    contacts_from: str | None = None
    dead_reckoned_distance_m: float | None = None
    dead_reckoning_error_m: float | None = None

    @staticmethod
    def from_run(record: RunRecord) -> "Estimates":
        """Return where guidance got its estimates from, and the error of its dead reckoning.

        Args:
            record: The recorded run, with the world states that guidance published.

        Returns:
            The estimates. Distance and error are None if no pose was estimated by dead reckoning.
        """
        if not record.worlds or len(record.time_s) == 0:
            return Estimates()
        newest = record.worlds[-1]
        dead_reckoned = [world for world in record.worlds if world.pose_from == "dead_reckoning"]
        known_errors_m: list[float] = []
        for world in dead_reckoned:
            error_m = _position_error_m(record, world)
            if error_m is not None:
                known_errors_m.append(error_m)
        distance_m = None
        if len(dead_reckoned) > 1:
            distance_m = _distance_between_m(record, dead_reckoned[0], dead_reckoned[-1])
        return Estimates(
            pose_from=newest.pose_from,
            contacts_from=newest.contacts_from,
            dead_reckoned_distance_m=distance_m,
            dead_reckoning_error_m=max(known_errors_m, default=None),
        )

    def in_words(self) -> list[str]:
        """Return a phrase for each estimate."""
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


def _position_error_m(record: RunRecord, world: World) -> float | None:
    """Return the distance from an estimated position to the measured one, or None if none was measured."""
    row = record.row_at(world.timestamp_ns * 1e-9)
    if not record.posed[row]:
        return None
    x, y, _ = record.position_w_m[row].tolist()
    return math.dist((x, y), world.base_position_w[:2])


def _distance_between_m(record: RunRecord, first: World, last: World) -> float | None:
    """Return the advance along the route between two world models; without a route, of the body's middle."""
    begin = _estimated_nodes_w(record, first)
    end = _estimated_nodes_w(record, last)
    if not (np.isfinite(begin).all() and np.isfinite(end).all()):
        return None
    route = record.route
    if route is None:
        return float(np.hypot(*(end - begin).mean(axis=0)))
    before_m = float(np.mean([route.project(node) for node in begin]))
    after_m = float(np.mean([route.project(node) for node in end]))
    return after_m - before_m


def _estimated_nodes_w(record: RunRecord, world: World) -> Floats:
    """Return tail end, joints and head end on the ground by the estimated pose, (joints + 2, 2)."""
    angles_rad = record.angle_rad[record.row_at(world.timestamp_ns * 1e-9)]
    return find_nodes_w(record.description, world.base_position_w, world.base_orientation_wxyz, angles_rad)[:, :2]
