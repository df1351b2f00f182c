"""Turns a depth image into a scan: the nearest upright surface in each azimuth. Pure.

The points of the image are split into ground, obstacles and the rest. A surface is upright if it spans height within
little range: a cylinder does, a hill does not. So a slope that the ground's plane misses is not taken for an obstacle.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.ranging.ground import MAX_FIT_RANGE_M, compute_tolerance_m, refine_plane
from snakesim_gnc.guidance.ranging.scan import MAX_RANGE_M, OBSTACLE_BAND_M, AzimuthScan, RangeNoise
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import DepthImage

Float32Array = NDArray[np.float32]

# Cells of range, in which a surface is sought.
CELL_M = 0.02  # near the camera
CELL_GROWTH_RANGE_M = 1.0  # beyond this range cells grow, as noise does
MIN_RISE_M = 0.02  # height that an upright surface spans within a cell
MIN_PIXEL_COUNT = 2  # of an upright surface in a cell

# The range of a surface.
RANGE_ITERATIONS = 2  # the mean of the pixels around the first cell, and of those around that mean
MAX_SPREAD_SD = 2.5  # standard deviations of range within which pixels belong to the surface
MAX_SPREAD_CELL_RATIO = 0.6  # of a cell, in addition
MIN_SURFACE_SD_M = 0.001  # of a surface's range, however many pixels it is the mean of

MIN_RANGE_M = 0.03
# Above the ground's offset from the camera, that the band of heights includes at least.
MIN_BAND_MARGIN_M = 0.02
GROUND_PIXEL_STRIDE = 7  # one pixel in so many is used for the ground's plane


@dataclass(frozen=True)
class CameraIntrinsics:
    """Intrinsics of a camera; pixel (u, v) sees along (1, -(u - cx) / fx, -(v - cy) / fy) in its frame."""

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    @staticmethod
    def from_image(image: DepthImage) -> "CameraIntrinsics":
        """Return the intrinsics of the image's camera."""
        return CameraIntrinsics(
            image.width, image.height, image.fx_px, image.fy_px, image.cx_px, image.cy_px
        )

    def compute_rays(self) -> Float32Array:
        """Compute the direction of each pixel in the camera's frame, (height * width, 3), row by row from the top.

        The directions have the length 1 along the camera's x axis.
        """
        v, u = np.mgrid[: self.height, : self.width]
        left = -(u - self.cx_px) / self.fx_px
        up = -(v - self.cy_px) / self.fy_px
        return np.stack([np.ones_like(left), left, up], axis=-1).reshape(-1, 3).astype(np.float32)


def decode_depth_m(image: DepthImage) -> Float32Array:
    """Decode the distances along the camera's x axis from a depth image.

    Returns:
        (height * width,) distances in m, row by row from the top; 0 where nothing was seen within the camera's range.
    """
    counts = np.frombuffer(image.depth, dtype="<u2").astype(np.float32)
    depth_m = counts * np.float32(image.scale_m)
    depth_m[(depth_m < image.range_min_m) | (depth_m > image.range_max_m)] = 0.0
    return depth_m


@dataclass(frozen=True)
class _DepthPixels:
    """Pixels that may show an obstacle; m is their number."""

    bins: NDArray[np.int32]  # (m,) of azimuth
    points: Float32Array  # (m, 3) from the camera, in the world's axes
    ranges_m: Float32Array  # (m,) from the camera, on the ground
    heights_m: Float32Array  # (m,) above the ground


class DepthScanner:
    """Makes scans from the images of one camera."""

    def __init__(self, intrinsics: CameraIntrinsics, noise: RangeNoise) -> None:
        self.intrinsics = intrinsics
        self._rays = intrinsics.compute_rays()
        self._noise = noise
        self._step_rad = 1.0 / intrinsics.fx_px
        self._cell_count = (
            math.ceil(CELL_GROWTH_RANGE_M * math.asinh(MAX_RANGE_M / CELL_GROWTH_RANGE_M) / CELL_M)
            + 1
        )

    def make_scan(
        self,
        depth_m: Float32Array,
        timestamp_ns: int,
        position_w: Floats,
        rotation: Floats,
        plane: Floats,
    ) -> AzimuthScan:
        """Convert a depth image into a scan of the upright surfaces around the robot.

        The ground plane is fitted first. Pixels on it show free space, and pixels in a band of heights above it show
        obstacles.

        Args:
            depth_m: (height * width,) distances along the camera's x axis; 0 where nothing was seen.
            timestamp_ns: Time of the image.
            position_w: (3,) position of the camera in the world, m.
            rotation: (3, 3) world_from_camera.
            plane: (3,) first guess of the ground: z = a + b x + c y in the world, with x and y from the camera.

        Returns:
            The scan, with one range, point and height for each bin of azimuth.
        """
        # The points that were seen, (m, 3), in the world's axes: x and y from the camera, z from the world's origin.
        pixels_with_depth = np.flatnonzero(depth_m)
        rays = self._rays[pixels_with_depth] @ rotation.T.astype(np.float32)
        points = rays * depth_m[pixels_with_depth, None]
        points[:, 2] += position_w[2]
        ranges_m = np.hypot(points[:, 0], points[:, 1])

        # Their heights above the ground, whose plane is fitted to points near the camera.
        near_points = np.flatnonzero(ranges_m < MAX_FIT_RANGE_M)[::GROUND_PIXEL_STRIDE]
        a, b, c = refine_plane(plane, points[near_points].astype(np.float64)).astype(np.float32)
        heights_m = points[:, 2] - (a + b * points[:, 0] + c * points[:, 1])

        # Bins of azimuth, counter-clockwise from the right edge of the view.
        heading_rad, fov_rad = self._compute_view(rotation)
        first_azimuth_rad = heading_rad - fov_rad / 2
        azimuth_from_first_rad = np.arctan2(rays[:, 1], rays[:, 0]) - np.float32(first_azimuth_rad)
        bins = (
            np.mod(azimuth_from_first_rad, np.float32(2 * math.pi)) / np.float32(self._step_rad)
        ).astype(np.int32)
        bin_count = math.ceil(fov_rad / self._step_rad)

        # Which of them show ground, and which may show an obstacle.
        is_valid = (ranges_m > MIN_RANGE_M) & (ranges_m < MAX_RANGE_M) & (bins < bin_count)
        ground_tolerance_m = compute_tolerance_m(ranges_m)
        is_ground = is_valid & (np.abs(heights_m) <= ground_tolerance_m)
        lowest_m = np.maximum(ground_tolerance_m, OBSTACLE_BAND_M[0])
        highest_m = max(OBSTACLE_BAND_M[1], a + MIN_BAND_MARGIN_M)
        band_pixels = np.flatnonzero(is_valid & (heights_m > lowest_m) & (heights_m < highest_m))

        # Farthest ground in each bin.
        free_m = np.zeros(bin_count)
        np.maximum.at(free_m, bins[is_ground], ranges_m[is_ground])
        pixels = _DepthPixels(
            bins[band_pixels], points[band_pixels], ranges_m[band_pixels], heights_m[band_pixels]
        )
        return self._make_scan_from_pixels(
            timestamp_ns, position_w[:2], first_azimuth_rad, free_m, pixels
        )

    def _compute_view(self, rotation: Floats) -> tuple[float, float]:
        """Return the azimuth of the middle of the field of view in the world, and the width of the view, in rad."""
        corners = (
            self._rays[[0, self.intrinsics.width - 1, -self.intrinsics.width, -1]] @ rotation.T
        )
        heading_rad = math.atan2(rotation[1, 0], rotation[0, 0])
        corner_offsets_rad = np.arctan2(corners[:, 1], corners[:, 0]) - heading_rad
        half_fov_rad = float(np.abs((corner_offsets_rad + math.pi) % (2 * math.pi) - math.pi).max())
        return heading_rad, min(2 * half_fov_rad + 2 * self._step_rad, 2 * math.pi)

    def _make_scan_from_pixels(
        self,
        timestamp_ns: int,
        origin_w: Floats,
        first_azimuth_rad: float,
        free_m: Floats,
        pixels: _DepthPixels,
    ) -> AzimuthScan:
        """Return the scan whose points are the mean of the pixels of the nearest upright surface in each bin.

        Args:
            timestamp_ns: Time of the image.
            origin_w: (2,) position of the camera in the world, m.
            first_azimuth_rad: Azimuth of the first bin's right edge in the world.
            free_m: (n_bins,) range up to which each bin shows ground; it applies to bins without a surface.
            pixels: The pixels that may show an obstacle.
        """
        bin_count = len(free_m)
        first_range_m = self._find_upright_range_m(pixels, bin_count)
        pixel_sd_m = self._noise.compute_sd_m(np.nan_to_num(first_range_m))
        range_m, is_on_surface = _average_ranges(pixels, first_range_m, pixel_sd_m)

        bins = pixels.bins[is_on_surface]
        points = pixels.points[is_on_surface]
        pixel_count = np.bincount(bins, minlength=bin_count).astype(np.float64)
        has_surface = pixel_count > 0
        total_x = np.bincount(bins, points[:, 0], bin_count)
        total_y = np.bincount(bins, points[:, 1], bin_count)
        mean_xy = (
            np.stack([total_x, total_y], axis=1)
            / np.where(has_surface, pixel_count, np.nan)[:, None]
        )
        top_m = np.full(bin_count, -np.inf)
        np.maximum.at(top_m, bins, pixels.heights_m[is_on_surface])
        mean_sd_m = pixel_sd_m / np.sqrt(np.maximum(pixel_count, 1.0))
        return AzimuthScan(
            timestamp_ns=timestamp_ns,
            origin_w=origin_w,
            first_azimuth_w=first_azimuth_rad,
            step_rad=self._step_rad,
            range_m=range_m,
            points_w=origin_w + mean_xy,
            sd_m=np.hypot(mean_sd_m, MIN_SURFACE_SD_M),
            free_m=np.where(has_surface, np.nan_to_num(range_m), free_m),
            top_m=np.where(has_surface, top_m, np.nan),
        )

    def _find_upright_range_m(self, pixels: _DepthPixels, bin_count: int) -> Floats:
        """Find the nearest upright surface in each bin of azimuth.

        Args:
            pixels: The pixels that may show an obstacle.
            bin_count: Number of bins.

        Returns:
            (bin_count,) ranges of the nearest cell with an upright surface in m; NaN for a bin without one.
        """
        # Each bin is divided into cells of range, whose size grows with the range as the derivative of sinh. All cells
        # of all bins have consecutive numbers: (m,) the number of the cell of each pixel.
        cell_of_bin = (
            np.arcsinh(pixels.ranges_m / CELL_GROWTH_RANGE_M) * (CELL_GROWTH_RANGE_M / CELL_M)
        ).astype(np.int32)
        cell = pixels.bins * self._cell_count + cell_of_bin
        cell_count = bin_count * self._cell_count

        # A cell is upright if its pixels span enough height.
        pixel_count = np.bincount(cell, minlength=cell_count)
        low_m = np.full(cell_count, np.inf, dtype=np.float32)
        high_m = np.full(cell_count, -np.inf, dtype=np.float32)
        np.minimum.at(low_m, cell, pixels.heights_m)
        np.maximum.at(high_m, cell, pixels.heights_m)
        is_upright = (pixel_count >= MIN_PIXEL_COUNT) & (high_m - low_m >= MIN_RISE_M)

        # The first upright cell of each bin, and the range of its middle.
        is_upright = is_upright.reshape(bin_count, self._cell_count)
        nearest_cells = is_upright.argmax(axis=1)
        range_m = CELL_GROWTH_RANGE_M * np.sinh(
            (nearest_cells + 0.5) * (CELL_M / CELL_GROWTH_RANGE_M)
        )
        return np.where(is_upright.any(axis=1), range_m, np.nan)


def _average_ranges(
    pixels: _DepthPixels, first_range_m: Floats, pixel_sd_m: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Average the ranges of the pixels of the surface in each bin.

    The pixels near the range of their bin are selected, and the range of the bin is set to their mean. This is done
    RANGE_ITERATIONS times.

    Args:
        pixels: The m pixels that may show an obstacle.
        first_range_m: (n_bins,) first guess of the range of the surface; NaN for a bin without one.
        pixel_sd_m: (n_bins,) standard deviation of the range of one pixel there.

    Returns:
        (n_bins,) mean ranges in m, NaN for a bin without a surface; and (m,) whether each pixel is on its surface.
    """
    bins = pixels.bins
    bin_count = len(first_range_m)
    max_error_m = MAX_SPREAD_SD * pixel_sd_m + MAX_SPREAD_CELL_RATIO * CELL_M
    range_m = first_range_m
    is_on_surface = np.zeros(len(bins), dtype=bool)
    for _ in range(RANGE_ITERATIONS):
        with np.errstate(invalid="ignore"):
            is_on_surface = np.abs(pixels.ranges_m - range_m[bins]) < max_error_m[bins]
        pixel_count = np.bincount(bins[is_on_surface], minlength=bin_count).astype(np.float64)
        total_m = np.bincount(bins[is_on_surface], pixels.ranges_m[is_on_surface], bin_count)
        range_m = total_m / np.where(pixel_count > 0, pixel_count, np.nan)
    return range_m, is_on_surface
