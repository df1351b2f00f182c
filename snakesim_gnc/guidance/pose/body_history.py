"""Where the body was during the last second, for samples that are located by their own timestamp. Pure."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_link_frames
from snakesim_hal.wire.messages import RobotDescription

HISTORY_NS = 1_000_000_000
# A sample may be this much newer than the newest joint state, which is used then.
MAX_AHEAD_NS = 50_000_000
AXIS_POINT_SPACING_M = 0.02


@dataclass(frozen=True)
class BasePose:
    """Pose of the base: x, y and heading on the ground, its height and its tilt."""

    planar_w: Floats  # (3,) x, y, heading
    z_m: float
    tilt: Floats  # (3, 3) level_from_base; the level frame has the base's heading

    @property
    def rotation(self) -> Floats:
        """Rotation matrix (3, 3) world_from_base."""
        return make_rotation_about_z(self.planar_w[2]) @ self.tilt

    @property
    def position_w(self) -> Floats:
        """Position (3,) in the world."""
        return np.array([self.planar_w[0], self.planar_w[1], self.z_m])


@dataclass(frozen=True)
class BodyFrames:
    """All links at one time; n is their number."""

    origins_w: Floats  # (n, 3)
    rotations: Floats  # (n, 3, 3) world_from_link
    head_end_w: Floats  # (3,) front end of the head

    def compute_axis_w(self) -> Floats:
        """Compute points along the body as seen from above, (m, 2), at most AXIS_POINT_SPACING_M apart."""
        body_points_w = np.vstack([self.origins_w, self.head_end_w])[:, :2]
        steps = np.diff(body_points_w, axis=0)
        s_m = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
        count = max(math.ceil(s_m[-1] / AXIS_POINT_SPACING_M), 2)
        sample_s_m = np.linspace(0.0, s_m[-1], count)
        x = np.interp(sample_s_m, s_m, body_points_w[:, 0])
        y = np.interp(sample_s_m, s_m, body_points_w[:, 1])
        return np.stack([x, y], axis=1)


class BodyHistory:
    """Stores base poses and joint angles by timestamp."""

    def __init__(self, robot: RobotDescription) -> None:
        self._axes = [joint.axis for joint in robot.joints]
        self._link_lengths_m = [link.length_m for link in robot.links]
        self._timestamps_ns: list[int] = []
        self._entries: list[tuple[BasePose, Floats]] = []

    def add(self, timestamp_ns: int, base: BasePose, angles_rad: Sequence[float]) -> None:
        """Store a base pose and joint angles. A timestamp that is not newer than the last one is ignored."""
        if self._timestamps_ns and timestamp_ns <= self._timestamps_ns[-1]:
            return
        self._timestamps_ns.append(timestamp_ns)
        self._entries.append((base, np.asarray(angles_rad, dtype=np.float64)))
        expired = bisect_left(self._timestamps_ns, timestamp_ns - HISTORY_NS)
        del self._timestamps_ns[:expired]
        del self._entries[:expired]

    def interpolate_base(self, timestamp_ns: int) -> BasePose | None:
        """Return the base pose at a time; None if the time is not in the history."""
        entry = self._interpolate_base_and_angles(timestamp_ns)
        return None if entry is None else entry[0]

    def interpolate_body(self, timestamp_ns: int) -> BodyFrames | None:
        """Return all links at a time; None if the time is not in the history."""
        entry = self._interpolate_base_and_angles(timestamp_ns)
        if entry is None:
            return None
        base, angles_rad = entry
        return self.compute_frames(base, angles_rad)

    def compute_frames(self, base: BasePose, angles_rad: Floats) -> BodyFrames:
        """Compute the frames of all links for a base pose and joint angles (n_joints,) (forward kinematics)."""
        origins_w, rotations = compute_link_frames(
            base.position_w, base.rotation, angles_rad, self._axes, self._link_lengths_m
        )
        head_w = origins_w[-1] + self._link_lengths_m[-1] * rotations[-1][:, 0]
        return BodyFrames(origins_w, rotations, head_w)

    def shift_all_poses(self, center_w: Floats, pose_shift: Floats) -> None:
        """Correct every stored base pose by the same rotation and translation.

        Args:
            center_w: (2,) point about which the poses are rotated, m.
            pose_shift: (3,) translation in x and y in m, and rotation in rad.
        """
        cosine = math.cos(pose_shift[2])
        sine = math.sin(pose_shift[2])
        for i, (base, angles_rad) in enumerate(self._entries):
            dx, dy = base.planar_w[:2] - center_w
            x = center_w[0] + cosine * dx - sine * dy + pose_shift[0]
            y = center_w[1] + sine * dx + cosine * dy + pose_shift[1]
            planar_w = np.array([x, y, base.planar_w[2] + pose_shift[2]])
            self._entries[i] = (BasePose(planar_w, base.z_m, base.tilt), angles_rad)

    def _interpolate_base_and_angles(self, timestamp_ns: int) -> tuple[BasePose, Floats] | None:
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
        previous_base, previous_angles_rad = self._entries[after - 1]
        next_base, next_angles_rad = self._entries[after]
        previous_ns = timestamps_ns[after - 1]
        ratio = (timestamp_ns - previous_ns) / (timestamps_ns[after] - previous_ns)
        # A tilt is not interpolated: the one nearer in time is used.
        step = next_base.planar_w - previous_base.planar_w
        step[2] = wrap_angle(step[2])
        base = BasePose(
            planar_w=previous_base.planar_w + ratio * step,
            z_m=previous_base.z_m + ratio * (next_base.z_m - previous_base.z_m),
            tilt=next_base.tilt if ratio > 0.5 else previous_base.tilt,
        )
        return base, previous_angles_rad + ratio * (next_angles_rad - previous_angles_rad)


def make_rotation_about_z(yaw_rad: float) -> Floats:
    """Return the rotation matrix (3, 3) about the z axis."""
    cosine = math.cos(yaw_rad)
    sine = math.sin(yaw_rad)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle between -pi and pi."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
