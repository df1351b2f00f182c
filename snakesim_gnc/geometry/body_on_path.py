"""A chain of links on a path: the joint angles of a body on it, and the place of a measured body along it. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from snakesim_gnc.control.climb import line_height_m
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.route import Route, next_on_route
from snakesim_hal.wire.messages import Rise

SPACING_M = 0.01  # of the cached poses; the interpolation error is 0.005 rad on paths that bend once in 0.15 m
CHORD_SPACING_M = 0.005  # of the cached chords
MAX_STEP_M = 0.05  # of one correction of the arc length
FIRST_STEPS = 8  # corrections for a body that may be anywhere
REFINE_STEPS = 2  # corrections from a good first guess


@dataclass(frozen=True)
class BodyPose:
    """Pose of the body on the path with its tail end at `tail_s_m`.

    Its nodes are the tail end, the joints that bend, and the head end: all on the path.
    """

    tail_s_m: float
    angles_rad: Floats  # (n_nodes - 2,) of the joints that bend, tail to head, left turn positive
    nodes_w: Floats  # (2, n_nodes): all x, then all y
    node_s_m: Floats  # (n_nodes,) arc length along the path


class BodyOnPath:
    """Lays one body on one path. It caches poses with the tail end at multiples of SPACING_M.

    A cached pose is an array of its angles, the nodes' x, the nodes' y, and the nodes' arc lengths.
    """

    def __init__(self, route: Route, segments_m: list[float], rises: Sequence[Rise] = ()) -> None:
        """Create the body.

        Args:
            route: the path.
            segments_m: lengths of the straight pieces between the joints that bend, tail to head.
            rises: of the path, which the body climbs. On a ramp a piece is shorter, as seen from above.
        """
        self.route = route
        self.segments_m = segments_m
        self._rises = rises
        self._bend_count = len(segments_m) - 1
        self._node_count = len(segments_m) + 1
        self._xy = slice(self._bend_count, self._bend_count + 2 * self._node_count)  # part of a cached pose
        self._poses: dict[int, Floats] = {}
        self._chord_ends: dict[float, dict[int, float]] = {length: {} for length in segments_m}

    def pose_at(self, tail_s_m: float) -> BodyPose:
        """Return the body with its tail end at an arc length, which may be before the path's start or after its end."""
        pose, _ = self._interpolate(tail_s_m)
        return BodyPose(
            tail_s_m=tail_s_m,
            angles_rad=pose[: self._bend_count],
            nodes_w=pose[self._xy].reshape(2, self._node_count),
            node_s_m=pose[self._xy.stop :],
        )

    def find_tail_s_m(self, nodes_w: Floats) -> float:
        """Return the arc length of the tail of a measured body that may be anywhere. nodes_w: (2, n_nodes)."""
        first_guess_m = self.route.project(nodes_w[:, 0])
        return self.refine_tail_s_m(nodes_w, first_guess_m, steps=FIRST_STEPS)

    def refine_tail_s_m(self, nodes_w: Floats, near_s_m: float, *, steps: int = REFINE_STEPS) -> float:
        """Return the arc length of the tail at which the body on the path is closest to a measured body.

        Gauss-Newton on the squared distances of the nodes: with e = measured - p(s), each step is e . p' / p' . p'.

        Args:
            nodes_w: (2, n_nodes) measured nodes of the body in the world, m.
            near_s_m: first guess of the arc length.
            steps: number of corrections.
        """
        measured = nodes_w.ravel()
        s_m = near_s_m
        for _ in range(steps):
            pose, slope = self._interpolate(s_m)
            along = slope[self._xy]
            step_m = float((measured - pose[self._xy]) @ along / (along @ along))
            s_m += min(max(step_m, -MAX_STEP_M), MAX_STEP_M)
        return s_m

    def _interpolate(self, tail_s_m: float) -> tuple[Floats, Floats]:
        """Return a pose at any arc length, and its derivative by the arc length."""
        place = tail_s_m / SPACING_M
        index = math.floor(place)
        low = self._cached_pose(index)
        rise = self._cached_pose(index + 1) - low
        return low + (place - index) * rise, rise / SPACING_M

    def _cached_pose(self, index: int) -> Floats:
        """Return the pose with the tail end at `index * SPACING_M`."""
        pose = self._poses.get(index)
        if pose is None:
            pose = self._lay_body(index * SPACING_M)
            self._poses[index] = pose
        return pose

    def _lay_body(self, tail_s_m: float) -> Floats:
        """Compute the pose of a body that lies on the path, node by node from the tail.

        Each node is the point of the path at the length of one segment ahead of the last node.

        Args:
            tail_s_m: arc length of the tail end on the path.

        Returns:
            One array: the angles in rad of the n joints that bend, then x, y and arc length in m of the n + 2 nodes.
        """
        s_m = tail_s_m
        x, y = self.route.point_at(s_m)
        node_s_m = [s_m]
        node_x = [x]
        node_y = [y]
        headings_rad: list[float] = []
        for length_m in self.segments_m:
            s_m = self._find_ahead_s_m(s_m, length_m)
            next_x, next_y = self.route.point_at(s_m)
            headings_rad.append(math.atan2(next_y - y, next_x - x))
            x, y = next_x, next_y
            node_s_m.append(s_m)
            node_x.append(x)
            node_y.append(y)
        angles_rad = [math.remainder(ahead - behind, math.tau) for behind, ahead in pairwise(headings_rad)]
        return np.array([*angles_rad, *node_x, *node_y, *node_s_m])

    def _find_ahead_s_m(self, s_m: float, length_m: float) -> float:
        """Return the arc length of the path's point at a straight distance ahead, between two cached chords.

        The end of a chord is nearly a linear function of its begin.
        """
        place = s_m / CHORD_SPACING_M
        index = math.floor(place)
        low_m = self._cached_chord_end_m(index, length_m)
        high_m = self._cached_chord_end_m(index + 1, length_m)
        return low_m + (place - index) * (high_m - low_m)

    def _cached_chord_end_m(self, index: int, length_m: float) -> float:
        """Return the arc length at which a chord ends that begins at `index * CHORD_SPACING_M`."""
        ends = self._chord_ends[length_m]
        end_m = ends.get(index)
        if end_m is None:
            end_m = self._find_chord_end_m(index * CHORD_SPACING_M, length_m)
            ends[index] = end_m
        return end_m

    def _find_chord_end_m(self, s_m: float, length_m: float) -> float:
        """Return the arc length at which a straight piece ends that begins at an arc length."""
        climb_m = line_height_m(self._rises, s_m + length_m) - line_height_m(self._rises, s_m)
        level_m = length_m
        if climb_m:
            level_m = math.sqrt(length_m**2 - min(climb_m**2, 0.5 * length_m**2))
        return next_on_route(self.route, self.route.point_at(s_m), s_m, level_m)


def chain_nodes(
    tail_w: tuple[float, float], heading_rad: float, angles_rad: Sequence[float], segments_m: Sequence[float]
) -> Floats:
    """Compute the nodes of a planar chain from its joint angles: tail end, joints that bend, head end.

    Args:
        tail_w: x and y of the tail end, m.
        heading_rad: heading of the tail's segment.
        angles_rad: angles of the joints that bend, tail to head, left turn positive.
        segments_m: lengths between the nodes.

    Returns:
        (2, n_nodes) x and y of the nodes, m.
    """
    x, y = tail_w
    node_x = [x]
    node_y = [y]
    for length_m, turn_rad in zip(segments_m, (*angles_rad, 0.0), strict=True):
        x += length_m * math.cos(heading_rad)
        y += length_m * math.sin(heading_rad)
        node_x.append(x)
        node_y.append(y)
        heading_rad += turn_rad
    return np.array((node_x, node_y))


def compute_heading_rad(wxyz: tuple[float, float, float, float]) -> float:
    """Return the heading on the ground of a frame's x axis, from the frame's quaternion."""
    w, x, y, z = wxyz
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
