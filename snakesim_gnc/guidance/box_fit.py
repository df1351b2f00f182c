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

from snakesim_gnc.guidance.circle_fit import OUTLIER_SD, soften_weights
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]

# Faces that were not seen.
DEPTH_M = 0.10  # of a box of which one face was seen
DEPTH_SD_M = 0.04
WALL_M = 0.45  # a longer face is a wall
WALL_THICKNESS_M = 0.05
END_SD_M = 0.008  # of the end of a seen face, where no other face was seen
MIN_FACE_M = 0.012  # a shorter run of points is only the corner of another face
MIN_HALF_M = 0.005

# The fit.
COARSE_RAD = np.arange(0.0, 90.0, 5.0) * math.pi / 180
FINE_RAD = np.array([-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]) * math.pi / 180
REWEIGHTINGS = 3
MIN_OUTWARD = 0.05  # part of a point's outward direction along an axis: with more, it may be the extreme of a face
FAR_M = 1e3  # place of a face to which no point belongs

LOW = -1.0  # outward directions of the two faces of an axis
HIGH = 1.0


@dataclass(frozen=True)
class Boxes:
    """Boxes in the world, one a row."""

    center_w: Floats  # (b, 2)
    yaw_rad: Floats  # (b,)
    half_m: Floats  # (b, 2) half size along and across yaw
    center_sd_m: Floats  # (b, 2) along and across yaw
    half_sd_m: Floats  # (b, 2)
    misfit: Floats  # (b,) sum of squared, weighted, limited distances
    seen_face_count: NDArray[np.int_]  # (b,) how many of the four faces were seen


@dataclass(frozen=True)
class _Points:
    """Points in the axes of headings: each field has one array (b, h, p) for each of the two axes."""

    place_m: tuple[Floats, Floats]
    outward: tuple[Floats, Floats]

    @classmethod
    def in_headings(cls, points: Floats, outward: Floats, yaw: Floats) -> "_Points":
        """Return points and outward directions, (b, p, 2) in the world, in the axes of headings (b, h)."""
        return cls(_rotate(points, yaw), _rotate(outward, yaw))


Faces = list[Floats]  # places of the four faces along their axes


def fit_boxes(points: Floats, weight: Floats, outward: Floats) -> Boxes:
    """Fit a box to the points of each obstacle.

    The heading of a box is searched in three rounds: among coarse candidates, among fine candidates around the best
    coarse one, and by a parabola through the misfits of the fine ones.

    Args:
        points: (b, p, 2) the p points of each of the b obstacles in the world, m.
        weight: (b, p) information in 1 / m²; 0 for padding.
        outward: (b, p, 2) unit vectors from the surface towards the sensor.

    Returns:
        One box for each obstacle.
    """
    weight = soften_weights(weight)
    rows = np.arange(len(points))
    coarse_rad = np.broadcast_to(COARSE_RAD, (len(points), len(COARSE_RAD)))
    _, misfit = _fit_faces(_Points.in_headings(points, outward, coarse_rad), weight)
    best = misfit.argmin(axis=1)

    fine_rad = coarse_rad[rows, best][:, None] + FINE_RAD
    _, misfit = _fit_faces(_Points.in_headings(points, outward, fine_rad), weight)
    best = misfit.argmin(axis=1)

    yaw_rad = fine_rad[rows, best] + _interpolate_minimum_rad(misfit, best)
    rotated_points = _Points.in_headings(points, outward, yaw_rad[:, None])
    faces, misfit = _fit_faces(rotated_points, weight)
    return _complete_boxes(rotated_points, weight, yaw_rad, faces, misfit[:, 0])


def _rotate(vectors: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Return vectors (b, p, 2) in the axes of headings (b, h), as components along and across: (b, h, p) each."""
    cosine = np.cos(yaw)[..., None]
    sine = np.sin(yaw)[..., None]
    x = vectors[:, None, :, 0]
    y = vectors[:, None, :, 1]
    return cosine * x + sine * y, cosine * y - sine * x


def _fit_faces(points: _Points, weight: Floats) -> tuple[Faces, Floats]:
    """Fit the four faces of a box to the points of each obstacle, for every candidate heading.

    A face is at the weighted mean of its points. The points are assigned to faces and get Huber weights again in
    every iteration.

    Args:
        points: the points in the coordinates of h candidate headings of each of the b obstacles.
        weight: (b, p) information of the points in 1 / m².

    Returns:
        The places of the four faces, (b, h) each in m, and the misfit (b, h). A face without points is far away.
    """
    weight = weight[:, None]
    faces = _extreme_faces(points, weight)
    for _ in range(REWEIGHTINGS):
        error_m, is_first_axis = _assign_faces(points, faces)
        huber = np.minimum(1.0, OUTLIER_SD / np.maximum(np.abs(error_m) * np.sqrt(weight), 1e-9))
        trusted = weight * huber
        for axis in (0, 1):
            is_this_axis = is_first_axis if axis == 0 else ~is_first_axis
            for face, direction in ((2 * axis, LOW), (2 * axis + 1, HIGH)):
                is_on_face = is_this_axis & (direction * points.outward[axis] > 0)
                face_weight = trusted * is_on_face
                total_weight = face_weight.sum(axis=2)
                mean_m = (face_weight * points.place_m[axis]).sum(axis=2) / np.maximum(total_weight, 1e-12)
                faces[face] = np.where(total_weight > 0, mean_m, faces[face])
    error_m, _ = _assign_faces(points, faces)
    misfit = np.minimum(weight * error_m * error_m, OUTLIER_SD**2).sum(axis=2)
    return faces, misfit


def _extreme_faces(points: _Points, weight: Floats) -> Faces:
    """Return first places of the faces: the outermost point that looks their way. weight: (b, 1, p)."""
    faces: Faces = []
    for axis in (0, 1):
        for direction in (LOW, HIGH):
            looks_this_way = (weight > 0) & (direction * points.outward[axis] > MIN_OUTWARD)
            extreme_m = np.where(looks_this_way, direction * points.place_m[axis], -FAR_M).max(axis=2)
            faces.append(direction * np.where(extreme_m > -FAR_M, extreme_m, FAR_M))
    return faces


def _assign_faces(points: _Points, faces: Faces) -> tuple[Floats, Bools]:
    """Assign each point to the nearer of the two faces that look its way.

    Returns:
        Distance of each point from its face in m, and whether that face is one of axis 0: (b, h, p) each.
    """
    distances: list[Floats] = []
    for axis in (0, 1):
        low_m = faces[2 * axis][..., None]
        high_m = faces[2 * axis + 1][..., None]
        distances.append(points.place_m[axis] - np.where(points.outward[axis] > 0, high_m, low_m))
    is_first_axis = np.abs(distances[0]) <= np.abs(distances[1])
    return np.where(is_first_axis, distances[0], distances[1]), is_first_axis


def _interpolate_minimum_rad(misfit: Floats, best: NDArray[np.intp]) -> Floats:
    """Return the offset, (b,), of the minimum of the parabola through the best fine heading and its neighbors."""
    rows = np.arange(len(best))
    center = np.clip(best, 1, misfit.shape[1] - 2)
    left = misfit[rows, center - 1]
    middle = misfit[rows, center]
    right = misfit[rows, center + 1]
    curvature = left - 2 * middle + right
    offset = np.where(curvature > 1e-9, 0.5 * (left - right) / np.maximum(curvature, 1e-9), 0.0)
    step_rad = FINE_RAD[1] - FINE_RAD[0]
    return np.where(center == best, np.clip(offset, -0.5, 0.5) * step_rad, 0.0)


def _complete_boxes(points: _Points, weight: Floats, yaw_rad: Floats, faces: Faces, misfit: Floats) -> Boxes:
    """Return complete boxes from the faces that the sensor saw, with assumed faces on the sides that it did not see.

    A sensor sees at most two faces of a box: one on each axis. The ends of both axes give the center and the size in
    the heading of the box, and the heading turns the center into the world.

    Args:
        points: the points of b obstacles, each in the coordinates of its one fitted heading.
        weight: (b, p) information of the points in 1 / m².
        yaw_rad: (b,) fitted headings.
        faces: places of the four faces, (b, 1) each in m: low and high along the heading, low and high across it.
        misfit: (b,) sum of the weighted squared distances of the points from the faces.

    Returns:
        The b boxes, with their centers in the world and the standard deviations of their sizes.
    """
    extents = _measure_extents(points, weight, faces)
    extent_x_m = extents.high_m[0] - extents.low_m[0]
    extent_y_m = extents.high_m[1] - extents.low_m[1]
    longest_m = np.maximum(extent_x_m, extent_y_m)
    is_wall = longest_m > WALL_M
    assumed_depth_m = np.where(is_wall, WALL_THICKNESS_M, DEPTH_M)  # of a box of which one face was seen
    center_m = np.empty((len(yaw_rad), 2))  # along the heading and across it
    half_m = np.empty((len(yaw_rad), 2))
    sd_m = np.empty((len(yaw_rad), 2))
    for axis in (0, 1):
        low_end_m, high_end_m, sd_m[:, axis] = _find_ends(axis, extents, faces, assumed_depth_m)
        center_m[:, axis] = 0.5 * (low_end_m + high_end_m)
        half_m[:, axis] = np.maximum(0.5 * (high_end_m - low_end_m), MIN_HALF_M)

    # Rotate the centers from the axes of the boxes into the world.
    cosine = np.cos(yaw_rad)
    sine = np.sin(yaw_rad)
    center_x = cosine * center_m[:, 0] - sine * center_m[:, 1]
    center_y = sine * center_m[:, 0] + cosine * center_m[:, 1]
    return Boxes(
        center_w=np.stack([center_x, center_y], axis=1),
        yaw_rad=yaw_rad,
        half_m=half_m,
        center_sd_m=sd_m,
        half_sd_m=sd_m.copy(),
        misfit=misfit,
        seen_face_count=np.sum(extents.is_seen, axis=0),
    )


@dataclass(frozen=True)
class _Extents:
    """What was seen of each obstacle, in its heading: lists by axis or by face, of arrays (b,)."""

    low_m: list[Floats]  # by axis: where the points begin
    high_m: list[Floats]  # by axis: where they end
    is_seen: list[Bools]  # by face
    information: list[Floats]  # by face, in 1 / m²


def _measure_extents(points: _Points, weight: Floats, faces: Faces) -> _Extents:
    """Find the faces that the sensor saw, and the range of the points along both axes of each box.

    A face was seen if the points on it extend over more than MIN_FACE_M.

    Args:
        points: the points of b obstacles, each in the coordinates of its one fitted heading.
        weight: (b, p) information of the points in 1 / m²; 0 for padding.
        faces: places of the four faces, (b, 1) each.

    Returns:
        Ranges for both axes, and whether each face was seen and with which information.
    """
    extents = _Extents([], [], [], [])
    _, is_first_axis = _assign_faces(points, faces)
    is_point = weight > 0
    for axis in (0, 1):
        place_m = points.place_m[axis][:, 0]
        along_face_m = points.place_m[1 - axis][:, 0]
        extents.low_m.append(np.where(is_point, place_m, np.inf).min(axis=1))
        extents.high_m.append(np.where(is_point, place_m, -np.inf).max(axis=1))
        is_this_axis = (is_first_axis if axis == 0 else ~is_first_axis)[:, 0]
        for direction in (LOW, HIGH):
            is_on_face = is_point & is_this_axis & (direction * points.outward[axis][:, 0] > 0)
            left_m = np.where(is_on_face, along_face_m, np.inf).min(axis=1)
            right_m = np.where(is_on_face, along_face_m, -np.inf).max(axis=1)
            extents.is_seen.append(right_m - left_m > MIN_FACE_M)
            extents.information.append(np.where(is_on_face, weight, 0.0).sum(axis=1))
    return extents


def _find_ends(axis: int, extents: _Extents, faces: Faces, assumed_depth_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Find the low end and the high end of b boxes along one axis.

    An end is the face there if the sensor saw that face. Otherwise, if the sensor saw a face of the other axis, the end
    is where the points of that face end. Otherwise the end is at an assumed depth behind the opposite face.

    Args:
        axis: 0 along the heading, 1 across it.
        extents: range of the points, and which faces were seen.
        faces: places of the four faces, (b, 1) each in m: low and high of axis 0, low and high of axis 1.
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

    low_end_if_unseen_m = np.where(saw_other_axis | ~saw_high, first_point_m, high_face_m - assumed_size_m)
    low_end_m = np.where(saw_low, low_face_m, low_end_if_unseen_m)
    high_end_if_unseen_m = np.where(saw_other_axis | ~saw_low, last_point_m, low_face_m + assumed_size_m)
    high_end_m = np.where(saw_high, high_face_m, high_end_if_unseen_m)

    unseen_sd_m = np.where(saw_other_axis, END_SD_M, DEPTH_SD_M)
    low_sd_m = np.where(saw_low, _sd_m(extents.information[low_face]), unseen_sd_m)
    high_sd_m = np.where(saw_high, _sd_m(extents.information[high_face]), unseen_sd_m)
    return low_end_m, high_end_m, 0.5 * np.hypot(low_sd_m, high_sd_m)


def _sd_m(information: Floats) -> Floats:
    return 1.0 / np.sqrt(np.maximum(information, 1.0))
