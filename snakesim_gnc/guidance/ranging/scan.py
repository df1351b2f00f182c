"""A scan: what a ranging sensor saw of upright surfaces, from above, by azimuth.

The measurements of all ranging sensors become scans: a depth image in `depth_scan.py`, the beams of a range finder or a
lidar here.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import DepthImage, RangeScan

OBSTACLE_BAND_M = (0.02, 0.12)  # height above the ground of what a snake's body can touch
MAX_RANGE_M = 4.0  # farther surfaces are too coarse to be mapped
DEFAULT_STEP_RAD = 1e-3  # of a range finder with one beam

RangingSample = DepthImage | RangeScan  # the messages that the map is made of


@dataclass(frozen=True)
class RangeNoise:
    """Standard deviation of a range: `floor_m` + `per_m2` range², as of stereo and structured light."""

    floor_m: float = 0.002
    per_m2: float = 0.003

    def compute_sd_m(self, range_m: Floats) -> Floats:
        """Return the standard deviations at ranges, in m."""
        return self.floor_m + self.per_m2 * range_m * range_m


@dataclass(frozen=True)
class AzimuthScan:
    """One measurement in n bins of equal width in azimuth, counter-clockwise from `first_azimuth_w`."""

    timestamp_ns: int
    # The sensor.
    origin_w: Floats  # (2,) its position on the ground
    first_azimuth_w: float  # of the right edge of the first bin
    step_rad: float  # width of a bin
    # The nearest upright surface in each bin.
    range_m: Floats  # (n,) NaN if none was seen
    points_w: Floats  # (n, 2) on that surface; NaN if there is none
    sd_m: Floats  # (n,) of each point, along the ray
    top_m: Floats  # (n,) highest point seen on the surface, above the ground; NaN if there is none
    # Free space.
    free_m: Floats  # (n,) range up to which nothing stands; 0 if unknown

    def find_bins(self, points_w: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Find the bins of azimuth in which points are.

        Args:
            points_w: (..., 2) points in the world, m.

        Returns:
            The bin of each point, -1 outside the field of view, and its range in m, (...) each.
        """
        offset = points_w - self.origin_w
        azimuth = np.arctan2(offset[..., 1], offset[..., 0]) - self.first_azimuth_w
        bins = np.floor(np.mod(azimuth, 2 * math.pi) / self.step_rad).astype(np.intp)
        ranges_m = np.hypot(offset[..., 0], offset[..., 1])
        return np.where(bins < len(self.range_m), bins, -1), ranges_m

    def compute_clear_distances_m(self) -> Floats:
        """Return the distance, (n,), up to which the sensor saw nothing in a bin and both its neighbors."""
        seen_m = np.where(np.isnan(self.range_m), self.free_m, self.range_m)
        padded_m = np.pad(seen_m, 1, mode="edge")
        neighbors_m = np.minimum(padded_m[:-2], padded_m[2:])
        return np.minimum(neighbors_m, seen_m)

    def mask_bins(self, is_masked: NDArray[np.bool_]) -> "AzimuthScan":
        """Return a copy without the points and the free space of some bins, such as those that show the own body.

        Args:
            is_masked: (n,) which bins are emptied.
        """
        return replace(
            self,
            range_m=np.where(is_masked, np.nan, self.range_m),
            points_w=np.where(is_masked[:, None], np.nan, self.points_w),
            free_m=np.where(is_masked, 0.0, self.free_m),
        )

    def move_to_base(self, old_base_w: Floats, new_base_w: Floats) -> "AzimuthScan":
        """Return a copy of the scan that is moved with the base, after a correction of the base pose.

        Args:
            old_base_w: (3,) x, y and heading of the base with which the points were computed.
            new_base_w: (3,) corrected x, y and heading of the base.
        """
        rotation_rad = new_base_w[2] - old_base_w[2]
        cosine = math.cos(rotation_rad)
        sine = math.sin(rotation_rad)
        rotation = np.array([[cosine, -sine], [sine, cosine]])
        return replace(
            self,
            origin_w=new_base_w[:2] + rotation @ (self.origin_w - old_base_w[:2]),
            points_w=new_base_w[:2] + (self.points_w - old_base_w[:2]) @ rotation.T,
            first_azimuth_w=self.first_azimuth_w + rotation_rad,
        )


def make_scan(
    ranges: RangeScan, position_w: Floats, rotation: Floats, ground_z_m: float, noise: RangeNoise
) -> AzimuthScan:
    """Project the ranges of a range finder or lidar onto the ground, as a scan in the world.

    A beam that ends within the band of heights in which obstacles concern the body is a hit. Other beams show only free
    space.

    Args:
        ranges: The message of the sensor; a range of None is unknown.
        position_w: (3,) position of the sensor, m.
        rotation: (3, 3) world_from_sensor.
        ground_z_m: Height of the ground in the world.
        noise: Noise of the ranges.

    Returns:
        The scan, with one range, point and height for each beam, counter-clockwise.
    """
    measured_m = np.array(
        [np.nan if value is None else value for value in ranges.range_m], dtype=np.float64
    )
    beam_count = len(measured_m)
    step_rad = ranges.angle_step_rad or DEFAULT_STEP_RAD
    angles_rad = ranges.angle_min_rad + step_rad * np.arange(beam_count)
    beam_directions_l = np.stack(
        [np.cos(angles_rad), np.sin(angles_rad), np.zeros(beam_count)], axis=1
    )
    beam_directions = beam_directions_l @ rotation.T
    if step_rad <= 0:
        # The bins of a scan are counter-clockwise.
        beam_directions = beam_directions[::-1]
        measured_m = measured_m[::-1]
    height_m = position_w[2] - ground_z_m + measured_m * beam_directions[:, 2]
    # Horizontal distance.
    range_m = measured_m * np.hypot(beam_directions[:, 0], beam_directions[:, 1])
    is_in_range = (range_m <= MAX_RANGE_M) & (measured_m < ranges.range_max_m)
    is_hit = is_in_range & (height_m > OBSTACLE_BAND_M[0]) & (height_m < OBSTACLE_BAND_M[1])
    points_w = position_w[:2] + measured_m[:, None] * beam_directions[:, :2]
    return AzimuthScan(
        timestamp_ns=ranges.timestamp_ns,
        origin_w=position_w[:2],
        first_azimuth_w=math.atan2(beam_directions[0, 1], beam_directions[0, 0])
        - 0.5 * abs(step_rad),
        step_rad=abs(step_rad),
        range_m=np.where(is_hit, range_m, np.nan),
        points_w=np.where(is_hit[:, None], points_w, np.nan),
        sd_m=noise.compute_sd_m(np.nan_to_num(range_m)),
        top_m=np.where(is_hit, height_m, np.nan),
        free_m=np.where(np.isnan(range_m), 0.0, np.minimum(range_m, MAX_RANGE_M)),
    )
