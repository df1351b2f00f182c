"""Fits boxes to the visible parts of surfaces, with standard deviations; many obstacles at once. Pure.

For each of a set of headings every point belongs to one of the two faces that look towards the sensor. The heading with
the smallest misfit wins (L-shape fitting by closeness, Zhang et al. 2017). A face that was not seen is open: the depth
behind a seen face is a guess with a large standard deviation, never less than what was seen.

In shapes, b is the number of obstacles, p the number of points of each, and h the number of headings. A heading has two
axes, 0 along it and 1 across it, and each axis has two faces, low and high: face 2 * axis + (0 low, 1 high).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.mapping.circle_fit import OUTLIER_THRESHOLD_SD, soften_weights
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]

# Faces that were not seen.
ASSUMED_DEPTH_M = 0.10  # of a box of which one face was seen
ASSUMED_DEPTH_SD_M = 0.04
MIN_WALL_LENGTH_M = 0.45  # a longer face is a wall
WALL_THICKNESS_M = 0.05
FACE_END_SD_M = 0.008  # of the end of a seen face, where no other face was seen
MIN_FACE_M = 0.012  # a shorter run of points is only the corner of another face
MIN_HALF_SIZE_M = 0.005

# The fit.
COARSE_YAWS_RAD = np.arange(0.0, 90.0, 5.0) * math.pi / 180
FINE_YAW_OFFSETS_RAD = np.array([-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]) * math.pi / 180
REWEIGHTING_ITERATIONS = 3
# A point may be the outermost one of a face if its direction to the sensor has more than this part along the axis.
MIN_DIRECTION_PART = 0.05
UNSEEN_FACE_M = 1e3  # position of a face to which no point belongs

LOW_SIDE = -1.0  # outward directions of the two faces of an axis
HIGH_SIDE = 1.0


@dataclass(frozen=True)
class FittedBoxes:
    """Boxes in the world, one a row."""

    center_w: Floats  # (b, 2)
    yaw_rad: Floats  # (b,)
    half_m: Floats  # (b, 2) half size along and across yaw
    center_sd_m: Floats  # (b, 2) along and across yaw
    half_size_sd_m: Floats  # (b, 2)
    fit_cost: Floats  # (b,) sum over the points of min(weight * distance², OUTLIER_THRESHOLD_SD²)
    seen_face_count: NDArray[np.int_]  # (b,) how many of the four faces were seen


@dataclass(frozen=True)
class _RotatedPoints:
    """Points in the axes of candidate boxes: each field has one array (b, h, p) for axis 0 and one for axis 1."""

    position_m: tuple[Floats, Floats]
    direction_to_sensor: tuple[Floats, Floats]

    @classmethod
    def rotate_points(
        cls, points_w: Floats, directions_to_sensor: Floats, yaw_rad: Floats
    ) -> "_RotatedPoints":
        """Rotate points and directions to the sensor from the world into the axes of candidate boxes.

        Args:
            points_w: (b, p, 2) points in the world, m.
            directions_to_sensor: (b, p, 2) unit vectors in the world.
            yaw_rad: (b, h) yaw angles of the candidate boxes.
        """
        return cls(_rotate(points_w, yaw_rad), _rotate(directions_to_sensor, yaw_rad))


# Positions of the four faces along their axes: low and high of axis 0, low and high of axis 1.
Faces = list[Floats]


def fit_boxes(points: Floats, weights: Floats, directions_to_sensor: Floats) -> FittedBoxes:
    """Fit a box to the points of each obstacle.

    The heading of a box is searched in three rounds: among coarse candidates, among fine candidates around the best
    coarse one, and by a parabola through the misfits of the fine ones.

    Args:
        points: (b, p, 2) the p points of each of the b obstacles in the world, m.
        weights: (b, p) information in 1 / m²; 0 for padding.
        directions_to_sensor: (b, p, 2) unit vectors from the surface towards the sensor.

    Returns:
        One box for each obstacle.
    """
    weights = soften_weights(weights)
    rows = np.arange(len(points))
    coarse_rad = np.broadcast_to(COARSE_YAWS_RAD, (len(points), len(COARSE_YAWS_RAD)))
    _, fit_cost = _fit_faces(
        _RotatedPoints.rotate_points(points, directions_to_sensor, coarse_rad), weights
    )
    best_candidate = fit_cost.argmin(axis=1)

    fine_rad = coarse_rad[rows, best_candidate][:, None] + FINE_YAW_OFFSETS_RAD
    _, fit_cost = _fit_faces(
        _RotatedPoints.rotate_points(points, directions_to_sensor, fine_rad), weights
    )
    best_candidate = fit_cost.argmin(axis=1)

    yaw_rad = fine_rad[rows, best_candidate] + _interpolate_best_yaw_offset_rad(
        fit_cost, best_candidate
    )
    rotated_points = _RotatedPoints.rotate_points(points, directions_to_sensor, yaw_rad[:, None])
    faces, fit_cost = _fit_faces(rotated_points, weights)
    return _complete_boxes(rotated_points, weights, yaw_rad, faces, fit_cost[:, 0])


def _rotate(vectors: Floats, yaw_rad: Floats) -> tuple[Floats, Floats]:
    """Rotate vectors by negative yaw angles, into the axes of candidate boxes.

    Args:
        vectors: (b, p, 2) vectors in the world.
        yaw_rad: (b, h) yaw angles of the candidate boxes.

    Returns:
        Components of the vectors along and across the yaw direction, (b, h, p) each.
    """
    cosine = np.cos(yaw_rad)[..., None]
    sine = np.sin(yaw_rad)[..., None]
    x = vectors[:, None, :, 0]
    y = vectors[:, None, :, 1]
    return cosine * x + sine * y, cosine * y - sine * x


def _fit_faces(points: _RotatedPoints, weights: Floats) -> tuple[Faces, Floats]:
    """Fit the four faces of a box to the points of each obstacle, for every candidate yaw angle.

    A face is at the weighted mean of its points. The points are assigned to faces and get Huber weights again in
    every iteration.

    Args:
        points: Points in the axes of h candidate boxes of each of the b obstacles.
        weights: (b, p) information of the points in 1 / m²; 0 for padding.

    Returns:
        The positions of the four faces, (b, h) each in m, and the cost (b, h). The position of a face without points
        is UNSEEN_FACE_M from the origin.
    """
    weights = weights[:, None]
    faces = _find_outermost_faces(points, weights)
    for _ in range(REWEIGHTING_ITERATIONS):
        error_m, is_first_axis = _assign_points_to_faces(points, faces)
        huber_factors = np.minimum(
            1.0, OUTLIER_THRESHOLD_SD / np.maximum(np.abs(error_m) * np.sqrt(weights), 1e-9)
        )
        robust_weights = weights * huber_factors
        for axis in (0, 1):
            is_this_axis = is_first_axis if axis == 0 else ~is_first_axis
            for face, direction in ((2 * axis, LOW_SIDE), (2 * axis + 1, HIGH_SIDE)):
                is_on_face = is_this_axis & (direction * points.direction_to_sensor[axis] > 0)
                face_weight = robust_weights * is_on_face
                total_weight = face_weight.sum(axis=2)
                mean_m = (face_weight * points.position_m[axis]).sum(axis=2) / np.maximum(
                    total_weight, 1e-12
                )
                faces[face] = np.where(total_weight > 0, mean_m, faces[face])
    error_m, _ = _assign_points_to_faces(points, faces)
    fit_cost = np.minimum(weights * error_m * error_m, OUTLIER_THRESHOLD_SD**2).sum(axis=2)
    return faces, fit_cost


def _find_outermost_faces(points: _RotatedPoints, weights: Floats) -> Faces:
    """Return initial positions of the four faces: the outermost point whose sensor was on the side of the face.

    Args:
        points: Points in the axes of the candidate boxes.
        weights: (b, 1, p) information of the points; 0 for padding.

    Returns:
        Positions of the four faces, (b, h) each in m; UNSEEN_FACE_M from the origin for a face without points.
    """
    faces: Faces = []
    for axis in (0, 1):
        for direction in (LOW_SIDE, HIGH_SIDE):
            looks_this_way = (weights > 0) & (
                direction * points.direction_to_sensor[axis] > MIN_DIRECTION_PART
            )
            extreme_m = np.where(
                looks_this_way, direction * points.position_m[axis], -UNSEEN_FACE_M
            ).max(axis=2)
            faces.append(direction * np.where(extreme_m > -UNSEEN_FACE_M, extreme_m, UNSEEN_FACE_M))
    return faces


def _assign_points_to_faces(points: _RotatedPoints, faces: Faces) -> tuple[Floats, Bools]:
    """Assign each point to the nearer of the two faces that are towards the sensor, one on each axis.

    Args:
        points: Points in the axes of the candidate boxes.
        faces: Positions of the four faces, (b, h) each in m.

    Returns:
        Distance of each point from its face in m, and whether that face is one of axis 0: (b, h, p) each.
    """
    distances: list[Floats] = []
    for axis in (0, 1):
        low_m = faces[2 * axis][..., None]
        high_m = faces[2 * axis + 1][..., None]
        distances.append(
            points.position_m[axis] - np.where(points.direction_to_sensor[axis] > 0, high_m, low_m)
        )
    is_first_axis = np.abs(distances[0]) <= np.abs(distances[1])
    return np.where(is_first_axis, distances[0], distances[1]), is_first_axis


def _interpolate_best_yaw_offset_rad(fit_cost: Floats, best_candidate: NDArray[np.intp]) -> Floats:
    """Interpolate the yaw angle of lowest cost between the candidates of the fine search.

    Args:
        fit_cost: (b, h) costs of the fine candidates.
        best_candidate: (b,) index of the candidate with the lowest cost.

    Returns:
        (b,) angle in rad from the best candidate to the minimum of the parabola through that candidate and its two
        neighbors; 0 if the best candidate is the first or the last one.
    """
    rows = np.arange(len(best_candidate))
    center_candidate = np.clip(best_candidate, 1, fit_cost.shape[1] - 2)
    left_cost = fit_cost[rows, center_candidate - 1]
    middle_cost = fit_cost[rows, center_candidate]
    right_cost = fit_cost[rows, center_candidate + 1]
    curvature = left_cost - 2 * middle_cost + right_cost
    offset = np.where(
        curvature > 1e-9, 0.5 * (left_cost - right_cost) / np.maximum(curvature, 1e-9), 0.0
    )
    step_rad = FINE_YAW_OFFSETS_RAD[1] - FINE_YAW_OFFSETS_RAD[0]
    return np.where(center_candidate == best_candidate, np.clip(offset, -0.5, 0.5) * step_rad, 0.0)


def _complete_boxes(
    points: _RotatedPoints, weights: Floats, yaw_rad: Floats, faces: Faces, fit_cost: Floats
) -> FittedBoxes:
    """Return complete boxes from the faces that the sensor saw, with assumed faces on the sides that it did not see.

    A sensor sees at most two faces of a box: one on each axis. The ends along both axes give the center and the size in
    the axes of the box; the center is then rotated into the world.

    Args:
        points: Points of b obstacles, in the axes of the fitted box of each obstacle, for h = 1 candidate yaw angle.
        weights: (b, p) inverse variances of the points in 1 / m²; 0 for padding.
        yaw_rad: (b,) fitted yaw angles.
        faces: Positions of the four faces, (b, 1) each in m.
        fit_cost: (b,) sum of the weighted squared distances of the points from the faces, which is stored in the boxes.

    Returns:
        The b boxes, with their centers in the world and the standard deviations of their sizes.
    """
    extents = _measure_extents(points, weights, faces)
    extent_x_m = extents.high_m[0] - extents.low_m[0]
    extent_y_m = extents.high_m[1] - extents.low_m[1]
    longest_m = np.maximum(extent_x_m, extent_y_m)
    is_wall = longest_m > MIN_WALL_LENGTH_M
    # Of a box of which one face was seen.
    assumed_depth_m = np.where(is_wall, WALL_THICKNESS_M, ASSUMED_DEPTH_M)
    center_box_m = np.empty((len(yaw_rad), 2))  # along the yaw direction and across it
    half_m = np.empty((len(yaw_rad), 2))  # half of the size
    end_sd_m = np.empty((len(yaw_rad), 2))
    for axis in (0, 1):
        low_end_m, high_end_m, end_sd_m[:, axis] = _find_box_ends(
            axis, extents, faces, assumed_depth_m
        )
        center_box_m[:, axis] = 0.5 * (low_end_m + high_end_m)
        half_m[:, axis] = np.maximum(0.5 * (high_end_m - low_end_m), MIN_HALF_SIZE_M)

    # Rotate the centers from the axes of the boxes into the world.
    cosine = np.cos(yaw_rad)
    sine = np.sin(yaw_rad)
    center_x = cosine * center_box_m[:, 0] - sine * center_box_m[:, 1]
    center_y = sine * center_box_m[:, 0] + cosine * center_box_m[:, 1]
    return FittedBoxes(
        center_w=np.stack([center_x, center_y], axis=1),
        yaw_rad=yaw_rad,
        half_m=half_m,
        # Center and half size are half the sum and half the difference of the two ends: same standard deviation.
        center_sd_m=end_sd_m,
        half_size_sd_m=end_sd_m.copy(),
        fit_cost=fit_cost,
        seen_face_count=np.sum(extents.is_seen, axis=0),
    )


@dataclass(frozen=True)
class _BoxExtents:
    """What was seen of each obstacle, in the axes of its box: lists by axis or by face, of arrays (b,)."""

    low_m: list[Floats]  # by axis: where the points begin
    high_m: list[Floats]  # by axis: where they end
    is_seen: list[Bools]  # by face
    information: list[Floats]  # by face, in 1 / m²


def _measure_extents(points: _RotatedPoints, weights: Floats, faces: Faces) -> _BoxExtents:
    """Find the faces that the sensor saw, and the range of the points along both axes of each box.

    A face was seen if the points on it extend over more than MIN_FACE_M.

    Args:
        points: Points of b obstacles, in the axes of the one fitted box of each (h = 1).
        weights: (b, p) information of the points in 1 / m²; 0 for padding.
        faces: Positions of the four faces, (b, 1) each in m.

    Returns:
        Ranges for both axes, and whether each face was seen and with which information.
    """
    extents = _BoxExtents([], [], [], [])
    _, is_first_axis = _assign_points_to_faces(points, faces)
    is_point = weights > 0
    for axis in (0, 1):
        position_m = points.position_m[axis][:, 0]
        along_face_m = points.position_m[1 - axis][:, 0]
        extents.low_m.append(np.where(is_point, position_m, np.inf).min(axis=1))
        extents.high_m.append(np.where(is_point, position_m, -np.inf).max(axis=1))
        is_this_axis = (is_first_axis if axis == 0 else ~is_first_axis)[:, 0]
        for direction in (LOW_SIDE, HIGH_SIDE):
            is_on_face = (
                is_point & is_this_axis & (direction * points.direction_to_sensor[axis][:, 0] > 0)
            )
            left_m = np.where(is_on_face, along_face_m, np.inf).min(axis=1)
            right_m = np.where(is_on_face, along_face_m, -np.inf).max(axis=1)
            extents.is_seen.append(right_m - left_m > MIN_FACE_M)
            extents.information.append(np.where(is_on_face, weights, 0.0).sum(axis=1))
    return extents


def _find_box_ends(
    axis: int, extents: _BoxExtents, faces: Faces, assumed_depth_m: Floats
) -> tuple[Floats, Floats, Floats]:
    """Find the low end and the high end of b boxes along one axis.

    An end is the face there if the sensor saw that face. Otherwise, if the sensor saw a face of the other axis, the end
    is where the points of that face end. Otherwise the end is at an assumed depth behind the opposite face.

    Args:
        axis: 0 along the yaw direction, 1 across it.
        extents: Range of the points, and which faces were seen.
        faces: Positions of the four faces, (b, 1) each in m.
        assumed_depth_m: (b,) size of a box along the axis of its only seen face, unless its points reach further.

    Returns:
        The low end, the high end, and the standard deviation of half the size, (b,) each in m.
    """
    low_face = 2 * axis
    high_face = low_face + 1
    other_axis = 1 - axis
    other_low_face = 2 * other_axis
    other_high_face = other_low_face + 1
    saw_low = extents.is_seen[low_face]
    saw_high = extents.is_seen[high_face]
    saw_other_axis = extents.is_seen[other_low_face] | extents.is_seen[other_high_face]
    first_point_m = extents.low_m[axis]
    last_point_m = extents.high_m[axis]
    assumed_size_m = np.maximum(assumed_depth_m, last_point_m - first_point_m)
    low_face_m = faces[low_face][:, 0]
    high_face_m = faces[high_face][:, 0]

    low_end_if_unseen_m = np.where(
        saw_other_axis | ~saw_high, first_point_m, high_face_m - assumed_size_m
    )
    low_end_m = np.where(saw_low, low_face_m, low_end_if_unseen_m)
    high_end_if_unseen_m = np.where(
        saw_other_axis | ~saw_low, last_point_m, low_face_m + assumed_size_m
    )
    high_end_m = np.where(saw_high, high_face_m, high_end_if_unseen_m)

    unseen_sd_m = np.where(saw_other_axis, FACE_END_SD_M, ASSUMED_DEPTH_SD_M)
    low_sd_m = np.where(saw_low, _compute_sd_m(extents.information[low_face]), unseen_sd_m)
    high_sd_m = np.where(saw_high, _compute_sd_m(extents.information[high_face]), unseen_sd_m)
    return low_end_m, high_end_m, 0.5 * np.hypot(low_sd_m, high_sd_m)


def _compute_sd_m(information: Floats) -> Floats:
    """Return the standard deviation in m of a position with an information in 1 / m², at most 1 m."""
    return 1.0 / np.sqrt(np.maximum(information, 1.0))
