"""A scan: what a ranging sensor saw of upright surfaces, from above, by azimuth. All ranging sensors become one.

A depth image becomes a scan in `depth_scan.py`; the beams of a range finder or a lidar do here.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import DepthImage, Ranges

BAND_M = (0.02, 0.12)  # height above the ground of what a snake's body can touch
MAX_RANGE_M = 4.0  # farther surfaces are too coarse to be worth mapping


Look = DepthImage | Ranges  # what the map is made of


@dataclass(frozen=True)
class Noise:
    """Standard deviation of one range: `floor_m` + `per_m2` x range², as of stereo and structured light."""

    floor_m: float = 0.002
    per_m2: float = 0.003

    def at(self, range_m: Floats) -> Floats:
        """At a range, in m."""
        return self.floor_m + self.per_m2 * range_m * range_m


@dataclass(frozen=True)
class Scan:
    """One look, in `len(range_m)` bins of equal width in azimuth, counter-clockwise from `azimuth_w`."""

    timestamp_ns: int
    origin_w: Floats  # (2,) of the sensor, on the ground
    azimuth_w: float  # of the first bin's right edge
    step_rad: float
    range_m: Floats  # (n,) of the nearest upright surface; NaN: none was seen
    points_w: Floats  # (n, 2) on that surface; NaN: none
    sd_m: Floats  # (n,) of each point, along the ray
    free_m: Floats  # (n,) up to here nothing stands; 0: unknown
    top_m: Floats  # (n,) highest point seen on the surface, above the ground; NaN: none

    def find_bins(self, points_w: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Bin and range of points (..., 2); bin -1 is outside the view."""
        offset = points_w - self.origin_w
        azimuth = np.arctan2(offset[..., 1], offset[..., 0]) - self.azimuth_w
        found = np.floor(np.mod(azimuth, 2 * math.pi) / self.step_rad).astype(np.intp)
        return np.where(found < len(self.range_m), found, -1), np.hypot(offset[..., 0], offset[..., 1])

    def clear_m(self) -> Floats:
        """How far one can see in each bin and both its neighbors: what is nearer is not there, (n,)."""
        seen = np.where(np.isnan(self.range_m), self.free_m, self.range_m)
        padded = np.pad(seen, 1, mode="edge")
        return np.minimum(np.minimum(padded[:-2], padded[2:]), seen)

    def without(self, hidden: NDArray[np.bool_]) -> "Scan":
        """The scan in which the hits of some bins (n,) count for nothing, such as those on the own body."""
        gone = np.where(hidden, np.nan, self.range_m)
        points = np.where(hidden[:, None], np.nan, self.points_w)
        free = np.where(hidden, 0.0, self.free_m)
        return replace(self, range_m=gone, points_w=points, free_m=free)

    def moved(self, from_w: Floats, to_w: Floats) -> "Scan":
        """The scan as it is when its base was not at `from_w` but at `to_w`, both (3,): x, y, heading."""
        turn = to_w[2] - from_w[2]
        c, s = math.cos(turn), math.sin(turn)
        rotation = np.array([[c, -s], [s, c]])
        origin = to_w[:2] + rotation @ (self.origin_w - from_w[:2])
        points = to_w[:2] + (self.points_w - from_w[:2]) @ rotation.T
        return replace(self, origin_w=origin, points_w=points, azimuth_w=self.azimuth_w + turn)


def make_scan(ranges: Ranges, position_w: Floats, rotation: Floats, ground_z_m: float, noise: Noise) -> Scan:
    """The scan of a range finder or lidar.

    position_w: (3,) of the sensor; rotation: (3, 3) world_from_sensor. Beams that end on the ground or above the body's
    band tell only what is free.
    """
    measured = np.array([np.nan if r is None else r for r in ranges.range_m], dtype=np.float64)
    count, step = len(measured), ranges.angle_step_rad or 1e-3
    angle = ranges.angle_min_rad + step * np.arange(count)
    beams = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1) @ rotation.T
    beams = beams if step > 0 else beams[::-1]
    measured = measured if step > 0 else measured[::-1]
    height = position_w[2] - ground_z_m + measured * beams[:, 2]
    flat = measured * np.hypot(beams[:, 0], beams[:, 1])
    near = (flat <= MAX_RANGE_M) & (measured < ranges.range_max_m)
    hit = near & (height > BAND_M[0]) & (height < BAND_M[1])
    points = position_w[:2] + measured[:, None] * beams[:, :2]
    return Scan(
        timestamp_ns=ranges.timestamp_ns,
        origin_w=position_w[:2],
        azimuth_w=math.atan2(beams[0, 1], beams[0, 0]) - 0.5 * abs(step),
        step_rad=abs(step),
        range_m=np.where(hit, flat, np.nan),
        points_w=np.where(hit[:, None], points, np.nan),
        sd_m=noise.at(np.nan_to_num(flat)),
        free_m=np.where(np.isnan(flat), 0.0, np.minimum(flat, MAX_RANGE_M)),
        top_m=np.where(hit, height, np.nan),
    )
