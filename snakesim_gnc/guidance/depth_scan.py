"""Turns a depth image into a scan: the nearest upright surface in each azimuth. Pure.

The points of the image are split into ground, obstacles and the rest. A surface is upright if it spans height within
little range: a cylinder does, a hill does not. So a slope that the ground's plane misses is not taken for an obstacle.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.ground import NEAR_M, refine_plane, tolerance_m
from snakesim_gnc.guidance.scan import BAND_M, MAX_RANGE_M, Noise, Scan
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import DepthImage

Singles = NDArray[np.float32]

# Cells of range, in which a surface is sought.
CELL_M = 0.02  # near the camera
STRETCH_M = 1.0  # beyond this range cells grow, as noise does
MIN_RISE_M = 0.02  # height that an upright surface spans within a cell
MIN_PIXELS = 2  # of an upright surface in a cell

# The range of a surface.
RANGE_ITERATIONS = 2  # the mean of the pixels around the first cell, and of those around that mean
SPREAD_SD = 2.5  # standard deviations of range within which pixels belong to the surface
CELL_RATIO = 0.6  # of a cell, in addition
SURFACE_SD_M = 0.001  # of a surface's range, however many pixels it is the mean of

MIN_RANGE_M = 0.03
HEAD_ROOM_M = 0.02  # above the ground's offset from the camera, that the band of heights includes at least
PLANE_EVERY = 7  # one pixel in so many is used for the ground's plane


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
    def from_image(image: DepthImage) -> "Intrinsics":
        """Return the intrinsics of the image's camera."""
        return Intrinsics(image.width, image.height, image.fx_px, image.fy_px, image.cx_px, image.cy_px)

    def rays(self) -> Singles:
        """Return the direction of each pixel, (height * width, 3), row by row from the top."""
        v, u = np.mgrid[: self.height, : self.width]
        left = -(u - self.cx_px) / self.fx_px
        up = -(v - self.cy_px) / self.fy_px
        return np.stack([np.ones_like(left), left, up], axis=-1).reshape(-1, 3).astype(np.float32)


def decode_depth_m(image: DepthImage) -> Singles:
    """Return distances along the camera's x axis, (height * width,); 0: nothing seen, or out of the camera's range."""
    counts = np.frombuffer(image.depth, dtype="<u2").astype(np.float32)
    depth_m = counts * np.float32(image.scale_m)
    depth_m[(depth_m < image.range_min_m) | (depth_m > image.range_max_m)] = 0.0
    return depth_m


@dataclass(frozen=True)
class _Pixels:
    """Pixels that may show an obstacle; m is their number."""

    bins: NDArray[np.int32]  # (m,) of azimuth
    points: Singles  # (m, 3) from the camera, in the world's axes
    ranges_m: Singles  # (m,) from the camera, on the ground
    heights_m: Singles  # (m,) above the ground


class DepthScanner:
    """Makes scans from the images of one camera."""

    def __init__(self, lens: Intrinsics, noise: Noise) -> None:
        self.lens = lens
        self._rays = lens.rays()
        self._noise = noise
        self._step_rad = 1.0 / lens.fx_px
        self._cells = math.ceil(STRETCH_M * math.asinh(MAX_RANGE_M / STRETCH_M) / CELL_M) + 1

    def scan(self, depth_m: Singles, timestamp_ns: int, position_w: Floats, rotation: Floats, plane: Floats) -> Scan:
        """Convert a depth image into a scan of the upright surfaces around the robot.

        The ground plane is fitted first. Pixels on it show free space, and pixels in a band of heights above it show
        obstacles.

        Args:
            depth_m: (height * width,) distances along the camera's x axis; 0 where nothing was seen.
            timestamp_ns: time of the image.
            position_w: (3,) position of the camera in the world, m.
            rotation: (3, 3) world_from_camera.
            plane: (3,) first guess of the ground: z = a + b x + c y in the world, with x and y from the camera.

        Returns:
            The scan, with one range, point and height for each bin of azimuth.
        """
        pixels_with_depth = np.flatnonzero(depth_m)
        rays = self._rays[pixels_with_depth] @ rotation.T.astype(np.float32)
        points = rays * depth_m[pixels_with_depth, None]  # from the camera, in the world's axes
        points[:, 2] += position_w[2]
        ranges_m = np.hypot(points[:, 0], points[:, 1])
        near_points = np.flatnonzero(ranges_m < NEAR_M)[::PLANE_EVERY]
        a, b, c = refine_plane(plane, points[near_points].astype(np.float64)).astype(np.float32)
        heights_m = points[:, 2] - (a + b * points[:, 0] + c * points[:, 1])

        # Bins of azimuth, counter-clockwise from the right edge of the view.
        heading_rad, fov_rad = self._view(rotation)
        first_rad = heading_rad - fov_rad / 2
        from_first_rad = np.arctan2(rays[:, 1], rays[:, 0]) - np.float32(first_rad)
        bins = (np.mod(from_first_rad, np.float32(2 * math.pi)) / np.float32(self._step_rad)).astype(np.int32)
        bin_count = math.ceil(fov_rad / self._step_rad)

        is_valid = (ranges_m > MIN_RANGE_M) & (ranges_m < MAX_RANGE_M) & (bins < bin_count)
        ground_m = tolerance_m(ranges_m)
        is_ground = is_valid & (np.abs(heights_m) <= ground_m)
        lowest_m = np.maximum(ground_m, BAND_M[0])
        highest_m = max(BAND_M[1], a + HEAD_ROOM_M)
        in_band = np.flatnonzero(is_valid & (heights_m > lowest_m) & (heights_m < highest_m))
        free_m = np.zeros(bin_count)
        np.maximum.at(free_m, bins[is_ground], ranges_m[is_ground])
        pixels = _Pixels(bins[in_band], points[in_band], ranges_m[in_band], heights_m[in_band])
        return self._make_scan(timestamp_ns, position_w[:2], first_rad, free_m, pixels)

    def _view(self, rotation: Floats) -> tuple[float, float]:
        """Return the azimuth of the middle of the view, and its width, in rad."""
        corners = self._rays[[0, self.lens.width - 1, -self.lens.width, -1]] @ rotation.T
        heading_rad = math.atan2(rotation[1, 0], rotation[0, 0])
        off_rad = np.arctan2(corners[:, 1], corners[:, 0]) - heading_rad
        half_rad = float(np.abs((off_rad + math.pi) % (2 * math.pi) - math.pi).max())
        return heading_rad, min(2 * half_rad + 2 * self._step_rad, 2 * math.pi)

    def _make_scan(
        self, timestamp_ns: int, origin_w: Floats, first_rad: float, free_m: Floats, pixels: _Pixels
    ) -> Scan:
        """Return the scan whose points are the mean of the pixels of the nearest upright surface in each bin.

        Args:
            timestamp_ns: time of the image.
            origin_w: (2,) position of the camera in the world, m.
            first_rad: azimuth of the first bin's right edge in the world.
            free_m: (n_bins,) range up to which each bin shows ground; it applies to bins without a surface.
            pixels: the pixels that may show an obstacle.
        """
        bin_count = len(free_m)
        first_range_m = self._find_upright_m(pixels, bin_count)
        pixel_sd_m = self._noise.sd_m(np.nan_to_num(first_range_m))
        range_m, on_surface = _average_ranges(pixels, first_range_m, pixel_sd_m)

        bins = pixels.bins[on_surface]
        points = pixels.points[on_surface]
        count = np.bincount(bins, minlength=bin_count).astype(np.float64)
        has_surface = count > 0
        total_x = np.bincount(bins, points[:, 0], bin_count)
        total_y = np.bincount(bins, points[:, 1], bin_count)
        mean_xy = np.stack([total_x, total_y], axis=1) / np.where(has_surface, count, np.nan)[:, None]
        top_m = np.full(bin_count, -np.inf)
        np.maximum.at(top_m, bins, pixels.heights_m[on_surface])
        mean_sd_m = pixel_sd_m / np.sqrt(np.maximum(count, 1.0))
        return Scan(
            timestamp_ns=timestamp_ns,
            origin_w=origin_w,
            azimuth_w=first_rad,
            step_rad=self._step_rad,
            range_m=range_m,
            points_w=origin_w + mean_xy,
            sd_m=np.hypot(mean_sd_m, SURFACE_SD_M),
            free_m=np.where(has_surface, np.nan_to_num(range_m), free_m),
            top_m=np.where(has_surface, top_m, np.nan),
        )

    def _find_upright_m(self, pixels: _Pixels, bin_count: int) -> Floats:
        """Return the range of the nearest cell with an upright surface in each bin, (n,); NaN if there is none."""
        cell_of_bin = (np.arcsinh(pixels.ranges_m / STRETCH_M) * (STRETCH_M / CELL_M)).astype(np.int32)
        cell = pixels.bins * self._cells + cell_of_bin
        cell_count = bin_count * self._cells
        pixel_count = np.bincount(cell, minlength=cell_count)
        low_m = np.full(cell_count, np.inf, dtype=np.float32)
        high_m = np.full(cell_count, -np.inf, dtype=np.float32)
        np.minimum.at(low_m, cell, pixels.heights_m)
        np.maximum.at(high_m, cell, pixels.heights_m)
        is_upright = (pixel_count >= MIN_PIXELS) & (high_m - low_m >= MIN_RISE_M)
        is_upright = is_upright.reshape(bin_count, self._cells)
        nearest = is_upright.argmax(axis=1)
        range_m = STRETCH_M * np.sinh((nearest + 0.5) * (CELL_M / STRETCH_M))
        return np.where(is_upright.any(axis=1), range_m, np.nan)


def _average_ranges(pixels: _Pixels, first_range_m: Floats, pixel_sd_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Average the ranges of the pixels of the surface in each bin.

    The pixels near the range of their bin are selected, and the range of the bin is set to their mean; and again.

    Args:
        pixels: the m pixels that may show an obstacle.
        first_range_m: (n_bins,) first guess of the range of the surface; NaN for a bin without one.
        pixel_sd_m: (n_bins,) standard deviation of the range of one pixel there.

    Returns:
        (n_bins,) mean ranges in m, NaN for a bin without a surface; and (m,) whether each pixel is on its surface.
    """
    bins = pixels.bins
    bin_count = len(first_range_m)
    max_error_m = SPREAD_SD * pixel_sd_m + CELL_RATIO * CELL_M
    range_m = first_range_m
    on_surface = np.zeros(len(bins), dtype=bool)
    for _ in range(RANGE_ITERATIONS):
        with np.errstate(invalid="ignore"):
            on_surface = np.abs(pixels.ranges_m - range_m[bins]) < max_error_m[bins]
        count = np.bincount(bins[on_surface], minlength=bin_count).astype(np.float64)
        total_m = np.bincount(bins[on_surface], pixels.ranges_m[on_surface], bin_count)
        range_m = total_m / np.where(count > 0, count, np.nan)
    return range_m, on_surface
