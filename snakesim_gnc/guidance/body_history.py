"""Where the body was during the last second, for samples that are located by their own timestamp. Pure."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames
from snakesim_hal.wire.messages import Description

HISTORY_NS = 1_000_000_000
MAX_AHEAD_NS = 50_000_000  # a sample may be this much newer than the newest joint state, which is used then
AXIS_STEP_M = 0.02


@dataclass(frozen=True)
class Base:
    """Pose of the base: x, y and heading on the ground, its height and its tilt."""

    planar_w: Floats  # (3,) x, y, heading
    z_m: float
    tilt: Floats  # (3, 3) level_from_base; the level frame has the base's heading

    @property
    def rotation(self) -> Floats:
        """Rotation matrix (3, 3) world_from_base."""
        return rotation_about_z(self.planar_w[2]) @ self.tilt

    @property
    def position_w(self) -> Floats:
        """Position (3,) in the world."""
        return np.array([self.planar_w[0], self.planar_w[1], self.z_m])


@dataclass(frozen=True)
class BodyFrames:
    """All links at one time; n is their number."""

    origins_w: Floats  # (n, 3)
    rotations: Floats  # (n, 3, 3) world_from_link
    head_w: Floats  # (3,) front end of the head

    def axis_w(self) -> Floats:
        """Return points (m, 2) along the body as seen from above, a few for each link."""
        nodes_w = np.vstack([self.origins_w, self.head_w])[:, :2]
        steps = np.diff(nodes_w, axis=0)
        s_m = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
        count = max(math.ceil(s_m[-1] / AXIS_STEP_M), 2)
        at_s_m = np.linspace(0.0, s_m[-1], count)
        x = np.interp(at_s_m, s_m, nodes_w[:, 0])
        y = np.interp(at_s_m, s_m, nodes_w[:, 1])
        return np.stack([x, y], axis=1)


class BodyHistory:
    """Stores base poses and joint angles by timestamp."""

    def __init__(self, robot: Description) -> None:
        self._axes = [joint.axis for joint in robot.joints]
        self._lengths = [link.length_m for link in robot.links]
        self._timestamps_ns: list[int] = []
        self._entries: list[tuple[Base, Floats]] = []

    def add(self, timestamp_ns: int, base: Base, angles_rad: Sequence[float]) -> None:
        """Store a base pose and joint angles. A timestamp that is not newer than the last one is ignored."""
        if self._timestamps_ns and timestamp_ns <= self._timestamps_ns[-1]:
            return
        self._timestamps_ns.append(timestamp_ns)
        self._entries.append((base, np.asarray(angles_rad, dtype=np.float64)))
        expired = bisect_left(self._timestamps_ns, timestamp_ns - HISTORY_NS)
        del self._timestamps_ns[:expired]
        del self._entries[:expired]

    def base_at(self, timestamp_ns: int) -> Base | None:
        """Return the base pose at a time; None if the time is not in the history."""
        entry = self._interpolate(timestamp_ns)
        return None if entry is None else entry[0]

    def body_at(self, timestamp_ns: int) -> BodyFrames | None:
        """Return all links at a time; None if the time is not in the history."""
        entry = self._interpolate(timestamp_ns)
        if entry is None:
            return None
        base, angles_rad = entry
        return self.compute_frames(base, angles_rad)

    def compute_frames(self, base: Base, angles_rad: Floats) -> BodyFrames:
        """Return all links for a base pose and joint angles (joints,)."""
        origins_w, rotations = link_frames(base.position_w, base.rotation, angles_rad, self._axes, self._lengths)
        head_w = origins_w[-1] + self._lengths[-1] * rotations[-1][:, 0]
        return BodyFrames(origins_w, rotations, head_w)

    def shift(self, center_w: Floats, shift: Floats) -> None:
        """Correct every base pose: turn it around a center (2,), then move it. shift: (3,) x, y, turn."""
        cosine = math.cos(shift[2])
        sine = math.sin(shift[2])
        for i, (base, angles_rad) in enumerate(self._entries):
            dx, dy = base.planar_w[:2] - center_w
            x = center_w[0] + cosine * dx - sine * dy + shift[0]
            y = center_w[1] + sine * dx + cosine * dy + shift[1]
            planar_w = np.array([x, y, base.planar_w[2] + shift[2]])
            self._entries[i] = (Base(planar_w, base.z_m, base.tilt), angles_rad)

    def _interpolate(self, timestamp_ns: int) -> tuple[Base, Floats] | None:
        """Interpolate the base pose and the joint angles at a time between two entries of the history.

        Returns:
            The base pose and the angles (n_joints,) in rad, or None if the time is before the first entry or more than
            MAX_AHEAD_NS after the last one.
        """
        timestamps_ns = self._timestamps_ns
        if not timestamps_ns:
            return None
        if not timestamps_ns[0] <= timestamp_ns <= timestamps_ns[-1] + MAX_AHEAD_NS:
            return None
        after = bisect_left(timestamps_ns, timestamp_ns)
        if after == len(timestamps_ns):
            return self._entries[-1]
        if after == 0 or timestamps_ns[after] == timestamp_ns:
            return self._entries[after]
        previous, previous_rad = self._entries[after - 1]
        following, following_rad = self._entries[after]
        previous_ns = timestamps_ns[after - 1]
        ratio = (timestamp_ns - previous_ns) / (timestamps_ns[after] - previous_ns)
        step = following.planar_w - previous.planar_w
        step[2] = wrap_angle(step[2])
        base = Base(
            planar_w=previous.planar_w + ratio * step,
            z_m=previous.z_m + ratio * (following.z_m - previous.z_m),
            tilt=following.tilt if ratio > 0.5 else previous.tilt,
        )
        return base, previous_rad + ratio * (following_rad - previous_rad)


def rotation_about_z(yaw_rad: float) -> Floats:
    """Return the rotation matrix (3, 3) about the z axis."""
    cosine = math.cos(yaw_rad)
    sine = math.sin(yaw_rad)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle between -pi and pi."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
