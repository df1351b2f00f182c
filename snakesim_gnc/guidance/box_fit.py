"""Boxes through the visible parts of surfaces, with covariance; many obstacles at once. Pure.

For each of a set of headings every point belongs to one of two faces, those that look towards who saw it; the heading
with the least misfit wins (L-shape fitting by closeness, Zhang et al. 2017). Faces that nobody saw are open: the depth
behind a seen face is a guess with a wide covariance, never less than what was seen.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.circle_fit import OUTLIER_SD, softened
from snakesim_hal.base.arrays import Floats

DEPTH_M, DEPTH_SD_M = 0.10, 0.04  # of a box of which one face was seen
WALL_M = 0.45  # a longer face is a wall,
THICKNESS_M = 0.05  # which is this thick unless its other side was seen
FAR_M = 1e3
MIN_FACE_M = 0.012  # along it
END_SD_M = 0.008  # of a face's end that no other face fixes
COARSE_RAD = np.arange(0.0, 90.0, 5.0) * math.pi / 180
FINE_RAD = np.array([-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]) * math.pi / 180


@dataclass(frozen=True)
class Boxes:
    """One a row."""

    center_w: Floats  # (b, 2)
    yaw_rad: Floats  # (b,)
    half_m: Floats  # (b, 2) along and across yaw
    center_sd_m: Floats  # (b, 2) along and across yaw
    half_sd_m: Floats  # (b, 2)
    misfit: Floats  # (b,)
    faces: NDArray[np.int_]  # (b,) how many were seen


Faces = list[Floats]  # places of the four faces in a heading's axes: along it low and high, across it low and high


def fit_boxes(points: Floats, weight: Floats, outward: Floats) -> Boxes:
    """points (b, p, 2), weight (b, p), outward (b, p, 2), as of `batched`."""
    weight = softened(weight)
    count = len(points)
    yaw, misfit = np.broadcast_to(COARSE_RAD, (count, len(COARSE_RAD))), np.empty(0)
    for around in (FINE_RAD, None):
        _, misfit = _faces(points, weight, outward, yaw)
        best = misfit.argmin(axis=1)
        yaw = yaw[np.arange(count), best] + (0.0 if around is not None else _between(misfit, best))
        yaw = yaw[:, None] + (0.0 if around is None else around)
    faces, misfit = _faces(points, weight, outward, yaw)
    return _closed(points, weight, outward, yaw[:, 0], [place[:, 0] for place in faces], misfit[:, 0])


def _turned(vectors: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Vectors (b, p, 2) in the axes of each heading (b, h): two of (b, h, p)."""
    c, s = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    x, y = vectors[:, None, :, 0], vectors[:, None, :, 1]
    return c * x + s * y, c * y - s * x


def _off(local: tuple[Floats, Floats], away: tuple[Floats, Floats], faces: Faces) -> tuple[Floats, NDArray[np.bool_]]:
    """Distance of each point from its face, and whether that is one of the first pair."""
    along, across = (
        at - np.where(towards > 0, faces[2 * k + 1][..., None], faces[2 * k][..., None])
        for k, (at, towards) in enumerate(zip(local, away, strict=True))
    )
    first = np.abs(along) <= np.abs(across)
    return np.where(first, along, across), first


def _faces(points: Floats, weight: Floats, outward: Floats, yaw: Floats) -> tuple[Faces, Floats]:
    """Places of the faces for headings (b, h), and the misfit, each (b, h). A face that nobody saw is far away."""
    local, away = _turned(points, yaw), _turned(outward, yaw)
    w = weight[:, None]
    faces: Faces = []
    for at, towards in zip(local, away, strict=True):
        for sign in (-1.0, 1.0):  # at first the extreme of what looks this way
            extreme = np.where((w > 0) & (sign * towards > 0.05), sign * at, -FAR_M).max(axis=2)
            faces.append(sign * np.where(extreme > -FAR_M, extreme, FAR_M))
    for _ in range(3):
        error, first = _off(local, away, faces)
        trusted = w * np.minimum(1.0, OUTLIER_SD / np.maximum(np.abs(error) * np.sqrt(w), 1e-9))
        for k, (at, towards) in enumerate(zip(local, away, strict=True)):
            for j, sign in enumerate((-1.0, 1.0)):
                mine = trusted * ((first if k == 0 else ~first) & (sign * towards > 0))
                total = mine.sum(axis=2)
                mean = (mine * at).sum(axis=2) / np.maximum(total, 1e-12)
                faces[2 * k + j] = np.where(total > 0, mean, faces[2 * k + j])
    error, _ = _off(local, away, faces)
    return faces, np.minimum(w * error * error, OUTLIER_SD**2).sum(axis=2)


def _between(misfit: Floats, best: NDArray[np.intp]) -> Floats:
    """Offset of the minimum of the parabola through the best heading and its neighbors, (b,)."""
    rows, at = np.arange(len(best)), np.clip(best, 1, misfit.shape[1] - 2)
    left, middle, right = misfit[rows, at - 1], misfit[rows, at], misfit[rows, at + 1]
    bend = left - 2 * middle + right
    offset = np.where(bend > 1e-9, 0.5 * (left - right) / np.maximum(bend, 1e-9), 0.0)
    step = FINE_RAD[1] - FINE_RAD[0]
    return np.where(at == best, np.clip(offset, -0.5, 0.5) * step, 0.0)


def _closed(points: Floats, weight: Floats, outward: Floats, yaw: Floats, faces: Faces, misfit: Floats) -> Boxes:
    """Boxes from the faces seen, closed where none was. yaw, faces, misfit: (b,) of each obstacle's own heading."""
    local, away = _turned(points, yaw[:, None]), _turned(outward, yaw[:, None])
    _, first = _off(local, away, [place[:, None] for place in faces])
    low, high, seen, information = [], [], [], []
    for k in (0, 1):
        at, along = local[k][:, 0], local[1 - k][:, 0]
        low.append(np.where(weight > 0, at, np.inf).min(axis=1))
        high.append(np.where(weight > 0, at, -np.inf).max(axis=1))
        for sign in (-1.0, 1.0):
            mine = (weight > 0) & (first if k == 0 else ~first)[:, 0] & (sign * away[k][:, 0] > 0)
            left, right = np.where(mine, along, np.inf).min(axis=1), np.where(mine, along, -np.inf).max(axis=1)
            seen.append(right - left > MIN_FACE_M)  # not just the corner of another
            information.append(np.where(mine, weight, 0.0).sum(axis=1))
    longest = np.maximum(high[0] - low[0], high[1] - low[1])
    depth = np.where(longest > WALL_M, THICKNESS_M, DEPTH_M)
    center, half = np.empty((len(yaw), 2)), np.empty((len(yaw), 2))
    center_sd, half_sd = np.empty_like(center), np.empty_like(half)
    for k in (0, 1):
        has_low, has_high = seen[2 * k], seen[2 * k + 1]
        ends = seen[2 - 2 * k] | seen[3 - 2 * k]  # a face of the other pair was seen: this pair is where its points end
        guess = np.maximum(depth, high[k] - low[k])
        bottom = np.where(ends | ~has_high, low[k], faces[2 * k + 1] - guess)
        top = np.where(ends | ~has_low, high[k], faces[2 * k] + guess)
        bottom = np.where(has_low, faces[2 * k], bottom)
        top = np.where(has_high, faces[2 * k + 1], top)
        open_sd = np.where(ends, END_SD_M, DEPTH_SD_M)
        sd_low, sd_high = (
            np.where(seen[2 * k + j], 1.0 / np.sqrt(np.maximum(information[2 * k + j], 1.0)), open_sd) for j in (0, 1)
        )
        center[:, k], half[:, k] = 0.5 * (bottom + top), np.maximum(0.5 * (top - bottom), 0.005)
        center_sd[:, k] = half_sd[:, k] = 0.5 * np.hypot(sd_low, sd_high)
    c, s = np.cos(yaw), np.sin(yaw)
    middle = np.stack([c * center[:, 0] - s * center[:, 1], s * center[:, 0] + c * center[:, 1]], axis=1)
    return Boxes(middle, yaw, half, center_sd, half_sd, misfit, np.sum(seen, axis=0))
