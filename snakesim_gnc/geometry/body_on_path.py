"""A chain of links on a path: the joint angles of a body on it, and the place of a measured body along it. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from snakesim_gnc.control.climb import compute_path_height_m
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.route import Route, find_arc_length_at_distance
from snakesim_hal.wire.messages import PathRise

POSE_SPACING_M = 0.01  # of the cached poses; the interpolation error is 0.005 rad on paths that bend once in 0.15 m
CHORD_SPACING_M = 0.005  # of the cached chords
MAX_STEP_M = 0.05  # of one correction of the arc length
FIRST_ITERATIONS = 8  # corrections for a body that may be anywhere
REFINE_ITERATIONS = 2  # corrections from a good first guess


@dataclass(frozen=True)
class PathBodyPose:
    """Pose of the body on the path with its tail end at `tail_s_m`.

    Its body points are the tail end, the joints that bend, and the head end: all on the path.
    """

    tail_s_m: float
    angles_rad: Floats  # (n_points - 2,) of the joints that bend, tail to head, left turn positive
    body_points_w: Floats  # (2, n_points): all x, then all y
    body_points_s_m: Floats  # (n_points,) arc length along the path


class BodyOnPath:
    """Lays one body on one path. It caches poses with the tail end at multiples of POSE_SPACING_M.

    A cached pose is an array of its angles, the points' x, the points' y, and the points' arc lengths.
    """

    def __init__(
        self, route: Route, segments_m: list[float], rises: Sequence[PathRise] = ()
    ) -> None:
        """Prepare to lay a body on a path, with empty caches.

        Args:
            route: The path.
            segments_m: Lengths of the straight segments between the joints that bend, tail to head.
            rises: Platforms on the path that the body climbs. On a ramp a segment is shorter, as seen from above.
        """
        self.route = route
        self.segments_m = segments_m
        self._rises = rises
        self._yaw_joint_count = len(segments_m) - 1
        self._point_count = len(segments_m) + 1
        self._points_slice = slice(
            self._yaw_joint_count, self._yaw_joint_count + 2 * self._point_count
        )  # part of a cached pose
        self._poses: dict[int, Floats] = {}
        self._chord_ends: dict[float, dict[int, float]] = {length: {} for length in segments_m}

    def compute_pose_at(self, tail_s_m: float) -> PathBodyPose:
        """Return the body with its tail end at an arc length, which may be before the path's start or after its end."""
        pose, _ = self._interpolate_pose(tail_s_m)
        return PathBodyPose(
            tail_s_m=tail_s_m,
            angles_rad=pose[: self._yaw_joint_count],
            body_points_w=pose[self._points_slice].reshape(2, self._point_count),
            body_points_s_m=pose[self._points_slice.stop :],
        )

    def find_tail_s_m(self, measured_points_w: Floats) -> float:
        """Return the arc length at which the tail of a measured body is on the path, without a first guess.

        Args:
            measured_points_w: (2, n_points) tail end, joints that bend and head end of the measured body, m.
        """
        first_guess_m = self.route.project_point(measured_points_w[:, 0])
        return self.refine_tail_s_m(measured_points_w, first_guess_m, step_count=FIRST_ITERATIONS)

    def refine_tail_s_m(
        self,
        measured_points_w: Floats,
        first_guess_s_m: float,
        *,
        step_count: int = REFINE_ITERATIONS,
    ) -> float:
        """Return the arc length of the tail at which the body on the path is closest to a measured body.

        Gauss-Newton on the squared distances of the body points: with e = measured - p(s), each step is
        e . p' / p' . p'.

        Args:
            measured_points_w: (2, n_points) tail end, joints that bend and head end of the measured body, m.
            first_guess_s_m: First guess of the arc length.
            step_count: Number of Gauss-Newton steps.
        """
        measured_xy = measured_points_w.ravel()
        s_m = first_guess_s_m
        for _ in range(step_count):
            pose, pose_derivative = self._interpolate_pose(s_m)
            points_derivative = pose_derivative[self._points_slice]
            step_m = float(
                (measured_xy - pose[self._points_slice])
                @ points_derivative
                / (points_derivative @ points_derivative)
            )
            s_m += min(max(step_m, -MAX_STEP_M), MAX_STEP_M)
        return s_m

    def _interpolate_pose(self, tail_s_m: float) -> tuple[Floats, Floats]:
        """Return the cached pose array at any arc length of the tail, and its derivative by that arc length."""
        index_fraction = tail_s_m / POSE_SPACING_M
        index = math.floor(index_fraction)
        low_pose = self._get_cached_pose(index)
        pose_step = self._get_cached_pose(index + 1) - low_pose
        return low_pose + (index_fraction - index) * pose_step, pose_step / POSE_SPACING_M

    def _get_cached_pose(self, index: int) -> Floats:
        """Return the pose with the tail end at `index * POSE_SPACING_M`."""
        pose = self._poses.get(index)
        if pose is None:
            pose = self._compute_pose(index * POSE_SPACING_M)
            self._poses[index] = pose
        return pose

    def _compute_pose(self, tail_s_m: float) -> Floats:
        """Compute the pose of a body that lies on the path, point by point from the tail.

        Each body point is the point of the path at the length of one segment ahead of the last body point.

        Args:
            tail_s_m: Arc length of the tail end on the path.

        Returns:
            One array: the angles in rad of the n joints that bend, then all x, all y and all arc lengths in m of the
            n + 2 body points (tail end, joints that bend, head end).
        """
        s_m = tail_s_m
        x, y = self.route.compute_point(s_m)
        points_s_m = [s_m]
        points_x = [x]
        points_y = [y]
        headings_rad: list[float] = []
        for length_m in self.segments_m:
            s_m = self._interpolate_chord_end_m(s_m, length_m)
            next_x, next_y = self.route.compute_point(s_m)
            headings_rad.append(math.atan2(next_y - y, next_x - x))
            x, y = next_x, next_y
            points_s_m.append(s_m)
            points_x.append(x)
            points_y.append(y)
        angles_rad = [
            math.remainder(ahead - behind, math.tau) for behind, ahead in pairwise(headings_rad)
        ]
        return np.array([*angles_rad, *points_x, *points_y, *points_s_m])

    def _interpolate_chord_end_m(self, s_m: float, length_m: float) -> float:
        """Return the arc length of the path's point at a straight distance ahead, between two cached chords.

        The end of a chord is nearly a linear function of its begin.
        """
        index_fraction = s_m / CHORD_SPACING_M
        index = math.floor(index_fraction)
        low_m = self._get_cached_chord_end_m(index, length_m)
        high_m = self._get_cached_chord_end_m(index + 1, length_m)
        return low_m + (index_fraction - index) * (high_m - low_m)

    def _get_cached_chord_end_m(self, index: int, length_m: float) -> float:
        """Return the arc length at which a chord ends that begins at `index * CHORD_SPACING_M`."""
        ends = self._chord_ends[length_m]
        end_m = ends.get(index)
        if end_m is None:
            end_m = self._find_chord_end_m(index * CHORD_SPACING_M, length_m)
            ends[index] = end_m
        return end_m

    def _find_chord_end_m(self, s_m: float, length_m: float) -> float:
        """Return the arc length at which a straight piece ends that begins at an arc length."""
        climb_m = compute_path_height_m(self._rises, s_m + length_m) - compute_path_height_m(
            self._rises, s_m
        )
        level_m = length_m
        if climb_m:
            level_m = math.sqrt(length_m**2 - min(climb_m**2, 0.5 * length_m**2))
        return find_arc_length_at_distance(self.route, self.route.compute_point(s_m), s_m, level_m)


def compute_chain_points(
    tail_w: tuple[float, float],
    heading_rad: float,
    angles_rad: Sequence[float],
    segments_m: Sequence[float],
) -> Floats:
    """Compute the points of a planar chain from its joint angles: tail end, joints that bend, head end.

    Args:
        tail_w: x and y of the tail end, m.
        heading_rad: Heading of the segment at the tail.
        angles_rad: Angles of the joints that bend, tail to head, left turn positive.
        segments_m: Lengths of the segments between the points, tail to head.

    Returns:
        (2, n_points) x and y of the points, m.
    """
    x, y = tail_w
    points_x = [x]
    points_y = [y]
    for length_m, turn_rad in zip(segments_m, (*angles_rad, 0.0), strict=True):
        x += length_m * math.cos(heading_rad)
        y += length_m * math.sin(heading_rad)
        points_x.append(x)
        points_y.append(y)
        heading_rad += turn_rad
    return np.array((points_x, points_y))


def compute_heading_rad(wxyz: tuple[float, float, float, float]) -> float:
    """Return the heading on the ground of a frame's x axis, from the frame's quaternion."""
    w, x, y, z = wxyz
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
