"""Present position and speed of the body along its path, from a world model that is some ticks old."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.body_on_path import BodyOnPath, chain_nodes, heading_of
from snakesim_gnc.control.controller import View
from snakesim_gnc.control.planar_body import PlanarBody
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Trajectory, World

Floats = NDArray[np.float64]

TICKS_KEPT = 128
AGAIN_STEPS = 8  # to localise a body again that may have slid meanwhile


@dataclass(frozen=True)
class Located:
    """The body on its path at one tick."""

    on_path: BodyOnPath
    tail_s_m: float  # arc length of the tail end
    speed_m_s: float
    nodes_w: Floats  # (2, n_nodes), last measurement
    fresh: bool  # there is a new world model
    anew: bool  # on a new path, or localised again after it was unknown: the position may have jumped
    world: World
    trajectory: Trajectory


class Progress:
    """Tracks the body along the path with an alpha-beta filter over poses, each with the joints of its instant.

    Only the yaw joints bend; all others count as straight. Between poses the tail is extrapolated at the last
    speed, so the result is always for the present. A world model that repeats a pose is not a new measurement: used
    as one, it would look like a body that stands still.
    """

    def __init__(self, body: PlanarBody, *, speed_filter_s: float) -> None:
        self._planar = body
        self._speed_filter_s = speed_filter_s
        self._angles: deque[tuple[int, list[float]]] = deque(maxlen=TICKS_KEPT)  # stamp of the joint state, angles
        self._body: BodyOnPath | None = None
        self._path_id: int | None = None
        self._world_tick: int | None = None
        self._measured_ns: int | None = None  # the pose's instant; None: the body's position is unknown
        self._nodes = np.empty((2, 0))
        self._s_m = 0.0  # at that instant
        self._speed_m_s = 0.0

    def update(self, view: View) -> Located | str:
        """Position of the body at this tick, or why it is unknown."""
        self._angles.append((view.joints.stamp_ns, view.joints.angle_rad))
        world, trajectory = view.world, view.trajectory
        if world is None or trajectory is None:
            self._measured_ns = None
            return "no world model" if world is None else "no trajectory"
        new_path = self._body is None or trajectory.path_id != self._path_id
        if new_path:
            self._body = BodyOnPath(Route(trajectory.path_w), self._planar.segments_m)
            self._path_id = trajectory.path_id
        body = self._body
        assert body is not None
        pose_ns = world.pose_stamp_ns
        if pose_ns is None or world.base_position_sd_m is not None:  # dead-reckoned up to the world's own stamp
            pose_ns = world.stamp_ns
        before_ns = self._measured_ns
        if before_ns is None or pose_ns > before_ns:
            self._measure(world, pose_ns)
        if new_path:
            self._s_m = body.find(self._nodes)  # the body is as fast as before
        elif before_ns is None:
            self._s_m, self._speed_m_s = body.fit(self._nodes, self._s_m, steps=AGAIN_STEPS), 0.0
        elif pose_ns > before_ns:
            self._filter(body, max(_seconds(pose_ns - before_ns, view), view.period_s))
        assert self._measured_ns is not None
        s = self._s_m + self._speed_m_s * _seconds(view.joints.stamp_ns - self._measured_ns, view)
        anew = new_path or before_ns is None
        fresh, self._world_tick = world.tick != self._world_tick, world.tick
        return Located(body, s, self._speed_m_s, self._nodes, fresh, anew, world, trajectory)

    def _measure(self, world: World, pose_ns: int) -> None:
        angles = next((a for stamp_ns, a in reversed(self._angles) if stamp_ns <= pose_ns), self._angles[0][1])
        bending = [angles[i] for i in self._planar.bends]
        heading = heading_of(world.base_orientation_wxyz)
        self._nodes = chain_nodes(world.base_position_w[:2], heading, bending, self._planar.segments_m)
        self._measured_ns = pose_ns

    def _filter(self, body: BodyOnPath, passed_s: float) -> None:
        """Critically damped alpha-beta filter with the time constant `speed_filter_s`."""
        expected = self._s_m + self._speed_m_s * passed_s
        off = body.fit(self._nodes, expected, steps=1) - expected
        keep = float(np.exp(-passed_s / self._speed_filter_s)) if self._speed_filter_s > 0 else 0.0
        self._s_m = expected + (1 - keep * keep) * off
        self._speed_m_s += (1 - keep) ** 2 * off / passed_s


def _seconds(elapsed_ns: int, view: View) -> float:
    """In whole periods if possible: these are equal on every machine."""
    return elapsed_ns / round(view.period_s * 1e9) * view.period_s
