"""Where the body is along its path now, and how fast it moves, from a world model that is some ticks old."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.body_on_path import BodyOnPath, chain_nodes, heading_of
from snakesim_gnc.control.controller import View
from snakesim_gnc.control.planar_body import PlanarBody
from snakesim_hal.messages import Trajectory, World
from snakesim_hal.route import Route

Floats = NDArray[np.float64]

TICKS_KEPT = 128


@dataclass(frozen=True)
class Located:
    """The body on its path at one tick."""

    on_path: BodyOnPath
    tail_s_m: float  # arc length of the tail end
    speed_m_s: float
    nodes_w: Floats  # (2, n_nodes), as measured at the newest world model's tick
    fresh: bool  # a new world model has come
    new_path: bool
    world: World
    trajectory: Trajectory


class Progress:
    """Follows the body along the path with an alpha-beta filter over world models, each matched with its own joints.

    The joints that bend are the yaw joints; all others count as straight. Between world models the tail goes on at
    the speed last seen, so what is returned is always the present.
    """

    def __init__(self, body: PlanarBody, *, speed_filter_s: float, oldest_world_s: float) -> None:
        self._planar = body
        self._speed_filter_s = speed_filter_s
        self._oldest_s = oldest_world_s
        self._angles: deque[tuple[int, list[float]]] = deque(maxlen=TICKS_KEPT)
        self._body: BodyOnPath | None = None
        self._path_id: int | None = None
        self._world: World | None = None
        self._nodes = np.empty((2, 0))
        self._s_m = 0.0  # at the tick of the newest world model
        self._speed_m_s = 0.0

    def update(self, view: View) -> Located | str:
        """Where the body is at this tick, or why that is unknown."""
        self._angles.append((view.tick, view.joints.angle_rad))
        world, trajectory = view.world, view.trajectory
        if world is None:
            return "no world model yet"
        if trajectory is None:
            return "no trajectory yet"
        age_s = (view.tick - world.tick) * view.period_s
        if age_s > self._oldest_s:
            return f"the world model is {age_s:.2f} s old; at most {self._oldest_s} s"
        new_path = self._body is None or trajectory.path_id != self._path_id
        if new_path:
            self._body = BodyOnPath(Route(trajectory.path_w), self._planar.segments_m)
            self._path_id = trajectory.path_id
        body = self._body
        assert body is not None
        fresh = self._world is None or world.tick != self._world.tick
        if fresh:
            self._measure(world)
        if new_path:
            self._s_m, self._speed_m_s = body.find(self._nodes), 0.0
        elif fresh:
            self._filter(body, world, view.period_s)
        self._world = world
        s = self._s_m + self._speed_m_s * age_s
        return Located(body, s, self._speed_m_s, self._nodes, fresh, new_path, world, trajectory)

    def _measure(self, world: World) -> None:
        angles = next((a for tick, a in reversed(self._angles) if tick <= world.tick), self._angles[0][1])
        bending = [angles[i] for i in self._planar.bends]
        heading = heading_of(world.base_orientation_wxyz)
        self._nodes = chain_nodes(world.base_position_w[:2], heading, bending, self._planar.segments_m)

    def _filter(self, body: BodyOnPath, world: World, period_s: float) -> None:
        """Critically damped alpha-beta filter with the time constant `speed_filter_s`."""
        assert self._world is not None
        passed_s = max((world.tick - self._world.tick) * period_s, period_s)
        expected = self._s_m + self._speed_m_s * passed_s
        off = body.fit(self._nodes, expected, steps=1) - expected
        keep = float(np.exp(-passed_s / self._speed_filter_s)) if self._speed_filter_s > 0 else 0.0
        self._s_m = expected + (1 - keep * keep) * off
        self._speed_m_s += (1 - keep) ** 2 * off / passed_s
