"""A chain on a path: the joint angles of a body on it, and the arc length of a measured body. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from snakesim_gnc.control.climb import line_height_m
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.route import Route, next_on_route
from snakesim_hal.wire.messages import Rise

SPACING_M = 0.01  # of the rows; the interpolation error is 0.005 rad on paths that bend once in 0.15 m
CHORD_SPACING_M = 0.005
MAX_STEP_M = 0.05  # of one correction of the arc length


@dataclass(frozen=True)
class BodyPose:
    """Pose of the body on the path with its tail end at `tail_s_m`.

    Its nodes are the tail end, the joints that bend, and the head end: all on the path.
    """

    tail_s_m: float
    angles_rad: Floats  # (n_nodes - 2,), tail to head, left turn positive
    nodes_w: Floats  # (2, n_nodes): all x, then all y
    node_s_m: Floats  # (n_nodes,), arc length along the path


class BodyOnPath:
    """Lays one body on one path; results are cached, in rows `SPACING_M` apart.

    segments_m: lengths of the straight pieces between the joints that bend, tail to head. rises: of the path, which a
    body climbs: on a ramp a piece is shorter, seen from above.
    """

    def __init__(self, route: Route, segments_m: list[float], rises: Sequence[Rise] = ()) -> None:
        self.route, self._rises = route, rises
        self.segments_m = segments_m
        self._bends = len(segments_m) - 1
        self._nodes = len(segments_m) + 1
        self._xy = slice(self._bends, self._bends + 2 * self._nodes)
        self._rows: dict[int, Floats] = {}
        self._chord_ends: dict[float, dict[int, float]] = {length: {} for length in segments_m}

    def pose_at(self, tail_s_m: float) -> BodyPose:
        """The body with its tail end at an arc length, which may be before the path's start or beyond its end."""
        row, _ = self._between(tail_s_m)
        return BodyPose(
            tail_s_m,
            row[: self._bends],
            row[self._xy].reshape(2, self._nodes),
            row[self._xy.stop :],
        )

    def find_tail_s_m(self, nodes_w: Floats) -> float:
        """Arc length of the tail of a body that may be anywhere; nodes_w: (2, n_nodes) as measured."""
        return self.refine_tail_s_m(nodes_w, self.route.project(nodes_w[:, 0]), steps=8)

    def refine_tail_s_m(self, nodes_w: Floats, near_s_m: float, *, steps: int = 2) -> float:
        """Arc length at which the body on the path is closest to a measured one (least squares over the nodes)."""
        measured = nodes_w.ravel()
        s = near_s_m
        for _ in range(steps):
            row, slope = self._between(s)
            along = slope[self._xy]
            step = float((measured - row[self._xy]) @ along / (along @ along))
            s += min(max(step, -MAX_STEP_M), MAX_STEP_M)
        return s

    def _between(self, s_m: float) -> tuple[Floats, Floats]:
        """A row at any arc length, and its derivative."""
        place = s_m / SPACING_M
        k = math.floor(place)
        low = self._row(k)
        rise = self._row(k + 1) - low
        return low + (place - k) * rise, rise / SPACING_M

    def _row(self, k: int) -> Floats:
        """Angles, node x, node y, node arc lengths with the tail at row k."""
        row = self._rows.get(k)
        if row is None:
            row = self._rows[k] = self._lay(k * SPACING_M)
        return row

    def _lay(self, tail_s_m: float) -> Floats:
        at, s = self.route.at, tail_s_m
        x, y = at(s)
        places, xs, ys = [s], [x], [y]
        headings: list[float] = []
        for length in self.segments_m:
            s = self._ahead(s, length)
            ahead_x, ahead_y = at(s)
            headings.append(math.atan2(ahead_y - y, ahead_x - x))
            x, y = ahead_x, ahead_y
            places.append(s)
            xs.append(x)
            ys.append(y)
        turns = [math.remainder(b - a, math.tau) for a, b in pairwise(headings)]
        return np.array([*turns, *xs, *ys, *places])

    def _ahead(self, s_m: float, length_m: float) -> float:
        """Arc length of the path's point at a straight distance ahead; between grid points it is nearly linear."""
        place = s_m / CHORD_SPACING_M
        k = math.floor(place)
        low, high = self._chord_end(k, length_m), self._chord_end(k + 1, length_m)
        return low + (place - k) * (high - low)

    def _chord_end(self, k: int, length_m: float) -> float:
        ends = self._chord_ends[length_m]
        end = ends.get(k)
        if end is None:
            s = k * CHORD_SPACING_M
            climbed_m = line_height_m(self._rises, s + length_m) - line_height_m(self._rises, s)
            level_m = math.sqrt(length_m**2 - min(climbed_m**2, 0.5 * length_m**2)) if climbed_m else length_m
            end = ends[k] = next_on_route(self.route, self.route.at(s), s, level_m)
        return end


def chain_nodes(
    tail_w: tuple[float, float], heading_rad: float, angles_rad: Sequence[float], segments_m: Sequence[float]
) -> Floats:
    """Nodes (2, n_nodes) of a planar chain: tail end, joints that bend, head end."""
    (x, y), heading = tail_w, heading_rad
    xs, ys = [x], [y]
    for length, turn in zip(segments_m, (*angles_rad, 0.0), strict=True):
        x += length * math.cos(heading)
        y += length * math.sin(heading)
        xs.append(x)
        ys.append(y)
        heading += turn
    return np.array((xs, ys))


def compute_heading_rad(wxyz: tuple[float, float, float, float]) -> float:
    """Heading on the ground of a frame's x axis, from its quaternion."""
    w, x, y, z = wxyz
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
