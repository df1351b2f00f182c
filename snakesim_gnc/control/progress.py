"""Present position and speed of the body along its path, from a world model that is some ticks old."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from snakesim_gnc.control.controller import View
from snakesim_gnc.geometry.body_on_path import BodyOnPath
from snakesim_gnc.geometry.planar_body import PlanarBody, RecentAngles, pose_instant_ns
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Trajectory, World
from snakesim_hal.wire.quantities import about, from_zero

SpeedFilter = Annotated[
    float, from_zero(1, "s"), about("time constant of the filter of the speed along the path; 0: none")
]
AGAIN_STEPS = 8  # to localize a body again that may have slid meanwhile


@dataclass(frozen=True)
class Located:
    """The body on its path at one tick."""

    on_path: BodyOnPath
    tail_s_m: float  # arc length of the tail end
    speed_m_s: float
    nodes_w: Floats  # (2, n_nodes), last measurement
    measured_s_m: float  # arc length of the tail end then
    fresh: bool  # there is a new world model
    restarted: bool  # on a new path, or localized again after it was unknown: the position may have jumped
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
        self._angles = RecentAngles()
        self._body: BodyOnPath | None = None
        self._path_id: int | None = None
        self._world_tick: int | None = None
        self._measured_ns: int | None = None  # the pose's instant; None: the body's position is unknown
        self._nodes = np.empty((2, 0))
        self._s_m = 0.0  # at that instant
        self._speed_m_s = 0.0

    def update(self, view: View) -> Located | str:
        """Position of the body at this tick, or why it is unknown."""
        self._angles.add(view.joints.timestamp_ns, view.joints.angle_rad)
        world, trajectory = view.world, view.trajectory
        if world is None or trajectory is None:
            self._measured_ns = None
            return "no world model" if world is None else "no trajectory"
        new_path = self._body is None or trajectory.path_id != self._path_id
        if new_path:
            self._body = BodyOnPath(Route(trajectory.path_w), self._planar.segments_m, trajectory.rises)
            self._path_id = trajectory.path_id
        body = self._body
        assert body is not None
        pose_ns, before_ns = pose_instant_ns(world), self._measured_ns
        if before_ns is None or pose_ns > before_ns:
            self._nodes = self._planar.nodes_w(world, self._angles.nearest_to(pose_ns))
            self._measured_ns = pose_ns
        if new_path:
            self._s_m = body.find_tail_s_m(self._nodes)  # the body is as fast as before
        elif before_ns is None:
            self._s_m, self._speed_m_s = body.refine_tail_s_m(self._nodes, self._s_m, steps=AGAIN_STEPS), 0.0
        elif pose_ns > before_ns:
            self._filter(body, max(_seconds(pose_ns - before_ns, view), view.period_s))
        assert self._measured_ns is not None
        s = self._s_m + self._speed_m_s * _seconds(view.joints.timestamp_ns - self._measured_ns, view)
        restarted = new_path or before_ns is None
        fresh, self._world_tick = world.tick != self._world_tick, world.tick
        return Located(body, s, self._speed_m_s, self._nodes, self._s_m, fresh, restarted, world, trajectory)

    def _filter(self, body: BodyOnPath, passed_s: float) -> None:
        """Critically damped alpha-beta filter with the time constant `speed_filter_s`."""
        expected = self._s_m + self._speed_m_s * passed_s
        off = body.refine_tail_s_m(self._nodes, expected, steps=1) - expected
        keep = float(np.exp(-passed_s / self._speed_filter_s)) if self._speed_filter_s > 0 else 0.0
        self._s_m = expected + (1 - keep * keep) * off
        self._speed_m_s += (1 - keep) ** 2 * off / passed_s


def _seconds(elapsed_ns: int, view: View) -> float:
    """In whole periods if possible: these are equal on every machine."""
    return elapsed_ns / round(view.period_s * 1e9) * view.period_s
