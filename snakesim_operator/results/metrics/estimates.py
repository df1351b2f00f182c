"""What guidance did not measure in a run but estimate, and how far that was from what was measured beside it."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import nodes_w
from snakesim_hal.wire.messages import World
from snakesim_operator.results.record import RunRecord


@dataclass(frozen=True)
class Estimates:
    """Of the last world model, and of all that were reckoned. None: unknown, or there was nothing to compare."""

    pose_from: str | None = None
    contacts_from: str | None = None
    reckoned_distance_m: float | None = None
    reckoned_off_m: float | None = None

    @staticmethod
    def of(record: RunRecord) -> "Estimates":
        """Distances only where the pose was reckoned."""
        if not record.worlds or len(record.time_s) == 0:
            return Estimates()
        last = record.worlds[-1]
        reckoned = [world for world in record.worlds if world.pose_from == "dead_reckoning"]
        offs = [off for world in reckoned if (off := _off_m(record, world)) is not None]
        moved = _moved_m(record, reckoned[0], reckoned[-1]) if len(reckoned) > 1 else None
        return Estimates(last.pose_from, last.contacts_from, moved, max(offs, default=None))

    def in_words(self) -> list[str]:
        """A sentence for each estimate."""
        said: list[str] = []
        if self.pose_from == "dead_reckoning":
            moved = "" if self.reckoned_distance_m is None else f", {self.reckoned_distance_m:.3f} m far"
            off = "" if self.reckoned_off_m is None else f", at most {100 * self.reckoned_off_m:.1f} cm off"
            said.append(f"the pose is reckoned{moved}{off}")
        if self.contacts_from == "joint_torques":
            said.append("contacts are estimated from joint torques")
        return said


def _off_m(record: RunRecord, world: World) -> float | None:
    row = record.row_at(world.timestamp_ns * 1e-9)
    if not record.posed[row]:
        return None
    x, y, _ = record.position_w[row].tolist()
    return math.dist((x, y), world.base_position_w[:2])


def _moved_m(record: RunRecord, first: World, last: World) -> float | None:
    """Along the route; without one, of the body's middle."""
    begin, end = _nodes_w(record, first), _nodes_w(record, last)
    if not (np.isfinite(begin).all() and np.isfinite(end).all()):
        return None
    if record.route is None:
        return float(np.hypot(*(end - begin).mean(axis=0)))
    route = record.route
    before_m, after_m = (float(np.mean([route.project(node) for node in nodes])) for nodes in (begin, end))
    return after_m - before_m


def _nodes_w(record: RunRecord, world: World) -> Floats:
    angles = record.angle_rad[record.row_at(world.timestamp_ns * 1e-9)]
    return nodes_w(record.description, world.base_position_w, world.base_orientation_wxyz, angles)[:, :2]
