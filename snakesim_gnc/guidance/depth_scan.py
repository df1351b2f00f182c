"""A depth image becomes a scan: points, minus the ground, then the nearest upright surface in each azimuth. Pure.

Upright is what spans height within little range: a hill does not, a cylinder does. So a slope that the ground's plane
misses is not taken for an obstacle.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.ground import NEAR_M, refined, tolerance_m
from snakesim_gnc.guidance.scan import BAND_M, MAX_RANGE_M, Noise, Scan
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import DepthImage

Singles = NDArray[np.float32]
CELL_M = 0.02  # of range near the camera; a surface is sought cell by cell,
STRETCH_M = 1.0  # and cells grow beyond this, as noise does
RISE_M = 0.02  # least height that an upright surface spans within a cell
MIN_PIXELS = 2  # in a cell
NEAR_LIMIT_M = 0.03
PLANE_EVERY = 7  # one pixel of these is used for the ground's plane


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera; pixel (u, v) sees along (1, -(u - cx) / fx, -(v - cy) / fy) in its frame."""

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    @staticmethod
    def of(image: DepthImage) -> "Intrinsics":
        """Of the image's camera."""
        return Intrinsics(image.width, image.height, image.fx_px, image.fy_px, image.cx_px, image.cy_px)

    def rays(self) -> Singles:
        """(height * width, 3), row by row from the top."""
        v, u = np.mgrid[: self.height, : self.width]
        left, up = -(u - self.cx_px) / self.fx_px, -(v - self.cy_px) / self.fy_px
        return np.stack([np.ones_like(left), left, up], axis=-1).reshape(-1, 3).astype(np.float32)


def metres_of(image: DepthImage) -> Singles:
    """Distance along the camera's x axis, (height * width,); 0: nothing seen, or beyond the camera's range."""
    counts = np.frombuffer(image.depth, dtype="<u2").astype(np.float32)
    depth = counts * np.float32(image.scale_m)
    depth[(depth < image.range_min_m) | (depth > image.range_max_m)] = 0.0
    return depth


class DepthScanner:
    """Scans of one camera."""

    def __init__(self, lens: Intrinsics, noise: Noise) -> None:
        self.lens = lens
        self._rays = lens.rays()
        self._noise = noise
        self._step_rad = 1.0 / lens.fx_px

    def scan(self, depth_m: Singles, timestamp_ns: int, position_w: Floats, rotation: Floats, plane: Floats) -> Scan:
        """depth_m: (height * width,). position_w, rotation: world_from_camera. plane: of the ground, first guess.

        The plane is z = a + b x + c y in the world, with x and y from the camera.
        """
        seen = np.flatnonzero(depth_m)
        rays = self._rays[seen] @ rotation.T.astype(np.float32)
        points = rays * depth_m[seen, None]  # from the camera, in the world's axes
        points[:, 2] += position_w[2]
        ranges = np.hypot(points[:, 0], points[:, 1])
        near = np.flatnonzero(ranges < NEAR_M)[::PLANE_EVERY]
        a, b, c = refined(plane, points[near].astype(np.float64)).astype(np.float32)
        heights = points[:, 2] - (a + b * points[:, 0] + c * points[:, 1])
        yaw, fov = self._view(rotation)
        turned = np.arctan2(rays[:, 1], rays[:, 0]) - np.float32(yaw - fov / 2)
        bins = (np.mod(turned, np.float32(2 * math.pi)) / np.float32(self._step_rad)).astype(np.int32)
        count = math.ceil(fov / self._step_rad)
        kept = (ranges > NEAR_LIMIT_M) & (ranges < MAX_RANGE_M) & (bins < count)
        limit = tolerance_m(ranges)
        floor = kept & (np.abs(heights) <= limit)
        band = np.flatnonzero(kept & (heights > np.maximum(limit, BAND_M[0])) & (heights < max(BAND_M[1], a + 0.02)))
        free = np.zeros(count)
        np.maximum.at(free, bins[floor], ranges[floor])
        return self._nearest(
            timestamp_ns, position_w[:2], yaw - fov / 2, free, bins[band], points[band], ranges[band], heights[band]
        )

    def _view(self, rotation: Floats) -> tuple[float, float]:
        """Azimuth of the middle of the view, and its width."""
        corners = self._rays[[0, self.lens.width - 1, -self.lens.width, -1]] @ rotation.T
        ahead = math.atan2(rotation[1, 0], rotation[0, 0])
        off = np.arctan2(corners[:, 1], corners[:, 0]) - ahead
        widest = float(np.abs((off + math.pi) % (2 * math.pi) - math.pi).max())
        return ahead, min(2 * widest + 2 * self._step_rad, 2 * math.pi)

    def _nearest(
        self,
        timestamp_ns: int,
        origin_w: Floats,
        first_w: float,
        free: Floats,
        bins: NDArray[np.int32],
        points: Singles,
        ranges: Singles,
        heights: Singles,
    ) -> Scan:
        """The nearest upright surface in each bin."""
        count, cells = len(free), math.ceil(STRETCH_M * math.asinh(MAX_RANGE_M / STRETCH_M) / CELL_M) + 1
        cell = bins * cells + (np.arcsinh(ranges / STRETCH_M) * (STRETCH_M / CELL_M)).astype(np.int32)
        pixels = np.bincount(cell, minlength=count * cells)
        low = np.full(count * cells, np.inf, dtype=np.float32)
        high = np.full(count * cells, -np.inf, dtype=np.float32)
        np.minimum.at(low, cell, heights)
        np.maximum.at(high, cell, heights)
        upright = ((pixels >= MIN_PIXELS) & (high - low >= RISE_M)).reshape(count, cells)
        has = upright.any(axis=1)
        at = STRETCH_M * np.sinh((upright.argmax(axis=1) + 0.5) * (CELL_M / STRETCH_M))
        at = np.where(has, at, np.nan)
        spread = self._noise.at(np.nan_to_num(at))
        n, ours = np.zeros(count), np.zeros(len(bins), dtype=bool)
        for _ in range(2):  # the mean of the pixels around the first find, and of those around that mean
            with np.errstate(invalid="ignore"):
                ours = np.abs(ranges - at[bins]) < (2.5 * spread + 0.6 * CELL_M)[bins]
            n = np.bincount(bins[ours], minlength=count).astype(np.float64)
            at = np.bincount(bins[ours], ranges[ours], count) / np.where(n > 0, n, np.nan)
        xy = np.stack([np.bincount(bins[ours], points[ours, k], count) for k in (0, 1)], axis=1)
        top = np.full(count, -np.inf)
        np.maximum.at(top, bins[ours], heights[ours])
        return Scan(
            timestamp_ns=timestamp_ns,
            origin_w=origin_w,
            azimuth_w=first_w,
            step_rad=self._step_rad,
            range_m=at,
            points_w=origin_w + xy / np.where(n > 0, n, np.nan)[:, None],
            sd_m=np.hypot(spread / np.sqrt(np.maximum(n, 1.0)), 0.001),
            free_m=np.where(n > 0, np.nan_to_num(at), free),
            top_m=np.where(n > 0, top, np.nan),
        )
