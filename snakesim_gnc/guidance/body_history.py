"""Where the body was, for the last second: an image is located with pose and joints of its own stamp. Pure."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames
from snakesim_hal.wire.messages import Description

KEPT_NS = 1_000_000_000
AHEAD_NS = 50_000_000  # a sensor may be this far ahead of the newest joint state, which is then used
AXIS_STEP_M = 0.02


@dataclass(frozen=True)
class Base:
    """Pose of the base: on the ground by x, y and heading, and what stands it off the ground."""

    planar_w: Floats  # (3,) x, y, heading
    z_m: float
    tilt: Floats  # (3, 3) level_from_base; the level frame has the base's heading

    @property
    def rotation(self) -> Floats:
        """(3, 3) world_from_base."""
        return about_z(self.planar_w[2]) @ self.tilt

    @property
    def position_w(self) -> Floats:
        """(3,)."""
        return np.array([self.planar_w[0], self.planar_w[1], self.z_m])


@dataclass(frozen=True)
class Body:
    """All links at one time."""

    origins_w: Floats  # (n, 3)
    rotations: Floats  # (n, 3, 3) world_from_link
    head_w: Floats  # (3,) its front end

    def axis_w(self) -> Floats:
        """Points (m, 2) along the body from above, a few a link."""
        nodes = np.vstack([self.origins_w, self.head_w])[:, :2]
        steps = np.hypot(*np.diff(nodes, axis=0).T)
        s = np.concatenate([[0.0], np.cumsum(steps)])
        at = np.linspace(0.0, s[-1], max(math.ceil(s[-1] / AXIS_STEP_M), 2))
        return np.stack([np.interp(at, s, nodes[:, 0]), np.interp(at, s, nodes[:, 1])], axis=1)


class BodyHistory:
    """Bases and joint angles by stamp."""

    def __init__(self, robot: Description) -> None:
        self._axes = [joint.axis for joint in robot.joints]
        self._lengths = [link.length_m for link in robot.links]
        self._stamps: list[int] = []
        self._kept: list[tuple[Base, Floats]] = []

    def add(self, timestamp_ns: int, base: Base, angles_rad: Sequence[float]) -> None:
        """Stamps must grow; an older or equal one is ignored."""
        if self._stamps and timestamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(timestamp_ns)
        self._kept.append((base, np.asarray(angles_rad, dtype=np.float64)))
        old = bisect_left(self._stamps, timestamp_ns - KEPT_NS)
        del self._stamps[:old], self._kept[:old]

    def base_at(self, timestamp_ns: int) -> Base | None:
        """The base at a time; None when that is not in the history."""
        found = self._at(timestamp_ns)
        return None if found is None else found[0]

    def body_at(self, timestamp_ns: int) -> Body | None:
        """All links at a time; None when that is not in the history."""
        found = self._at(timestamp_ns)
        return None if found is None else self.lay(*found)

    def lay(self, base: Base, angles_rad: Floats) -> Body:
        """All links of a base and joint angles."""
        origins, rotations = link_frames(base.position_w, base.rotation, angles_rad, self._axes, self._lengths)
        return Body(origins, rotations, origins[-1] + self._lengths[-1] * rotations[-1][:, 0])

    def move(self, around_w: Floats, by: Floats) -> None:
        """Correct every base: turned around a place (2,) by by[2], then moved by by[:2]."""
        c, s = math.cos(by[2]), math.sin(by[2])
        for i, (base, angles) in enumerate(self._kept):
            dx, dy = base.planar_w[:2] - around_w
            x, y = around_w[0] + c * dx - s * dy + by[0], around_w[1] + s * dx + c * dy + by[1]
            self._kept[i] = Base(np.array([x, y, base.planar_w[2] + by[2]]), base.z_m, base.tilt), angles

    def _at(self, timestamp_ns: int) -> tuple[Base, Floats] | None:
        if not self._stamps or not self._stamps[0] <= timestamp_ns <= self._stamps[-1] + AHEAD_NS:
            return None
        after = bisect_left(self._stamps, timestamp_ns)
        if after == len(self._stamps):
            return self._kept[-1]
        (late, late_rad), late_ns = self._kept[after], self._stamps[after]
        if after == 0 or late_ns == timestamp_ns:
            return late, late_rad
        (early, early_rad), early_ns = self._kept[after - 1], self._stamps[after - 1]
        share = (timestamp_ns - early_ns) / (late_ns - early_ns)
        step = late.planar_w - early.planar_w
        step[2] = wrapped(step[2])
        nearer = late if share > 0.5 else early
        z_m = early.z_m + share * (late.z_m - early.z_m)
        return Base(early.planar_w + share * step, z_m, nearer.tilt), early_rad + share * (late_rad - early_rad)


def about_z(yaw_rad: float) -> Floats:
    """Rotation (3, 3)."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wrapped(angle_rad: float) -> float:
    """The same angle, within half a turn."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
