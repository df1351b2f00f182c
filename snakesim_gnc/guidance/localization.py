"""Where the base is: dead reckoning, corrected by the pose sensor when there is one, and by the map. Pure.

An extended Kalman filter of x, y and heading. A measurement is compared with where the base was at its stamp, so a late
one corrects what has happened since as well. A pose that jumps is not believed, unless it stays there.
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from snakesim_gnc.guidance.body_history import Base, BodyHistory, about_z, wrapped
from snakesim_gnc.guidance.odometry import Odometry, Step
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import rotation_from_quaternion, yaw_of
from snakesim_hal.wire.messages import Contacts, Description, Imu, JointState, Pose

MessageT = TypeVar("MessageT", Contacts, Imu)
GATE = 25.0  # squared Mahalanobis distance
JUMP_S = 0.3  # a pose that is refused for longer than this was right: the robot has been carried
MIN_SD = np.array([0.0005, 0.0005, 0.001])  # of a pose sensor, m and rad
START_SD = np.array([0.01, 0.01, 0.02])  # of the start pose, by which a robot without a pose sensor begins
LEVEL_S = 0.5  # over which accelerations are averaged to tell what is level
MIN_OWN_SHARE = 0.05  # share of the variance that is the robot's own, not the map's
FRESH_NS = 60_000_000  # contacts and gyros count for steps within this of them


@dataclass(frozen=True)
class PoseNoise:
    """Of the pose sensor."""

    position_m: float = 0.001
    angle_rad: float = 0.002


class Localizer:
    """One robot's place in the world."""

    def __init__(self, robot: Description, start: Base, noise: PoseNoise) -> None:
        """start: where it is laid down. noise: of the pose sensor, if there is one."""
        self.history = BodyHistory(robot)
        self._odometry = Odometry(robot)
        self._start = self.base = start
        self._measured = np.square(np.maximum([noise.position_m, noise.position_m, noise.angle_rad], MIN_SD))
        self.covariance = np.diag(START_SD**2)  # (3, 3) of x, y and heading
        self.pose_timestamp_ns: int | None = None  # of the newest pose that was believed
        self.refused = 0
        self.carried_m = 0.0  # jump that was believed at the last measurement; 0: none
        self._refused_since_ns: int | None = None
        self._up_b: Floats | None = None

    @property
    def position_sd_m(self) -> float:
        """In the worst direction."""
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance[:2, :2])[-1]), 0.0))

    @property
    def yaw_sd_rad(self) -> float:
        """Of the heading."""
        return math.sqrt(float(self.covariance[2, 2]))

    def move(self, joints: JointState, contacts: Contacts | None, imu: Imu | None) -> None:
        """Dead reckoning up to a joint state."""
        if imu is not None and self.pose_timestamp_ns is None:
            self._level(imu)
        step = self._odometry.step(joints, self.base.tilt, _fresh(contacts, joints), _fresh(imu, joints))
        if step is not None:
            self._go(step)
        self.history.add(joints.timestamp_ns, self.base, joints.angle_rad)

    def add_pose(self, pose: Pose) -> None:
        """A new sample of the pose sensor."""
        self.carried_m = 0.0
        if self.pose_timestamp_ns is not None and pose.timestamp_ns <= self.pose_timestamp_ns:
            return
        rotation = rotation_from_quaternion(pose.orientation_wxyz)
        yaw = yaw_of(rotation)
        measured = np.array([*pose.position_w[:2], yaw])
        then = self.history.base_at(pose.timestamp_ns)
        if then is None:
            return
        if self.pose_timestamp_ns is not None and not self._plausible(measured - then.planar_w):
            self.refused += 1
            self._refused_since_ns = self._refused_since_ns or pose.timestamp_ns
            if pose.timestamp_ns - self._refused_since_ns < JUMP_S * 1e9:
                return
            self.carried_m = float(np.hypot(*(measured - then.planar_w)[:2]))
            self.covariance = np.diag([1.0, 1.0, 1.0])
        if self.pose_timestamp_ns is None:
            self.covariance = np.diag([10.0, 10.0, 10.0])  # the first one counts alone
        self._refused_since_ns = None
        self.pose_timestamp_ns = pose.timestamp_ns
        self.base = Base(self.base.planar_w, pose.position_w[2], about_z(-yaw) @ rotation)
        self.correct(then, measured, np.diag(self._measured))

    def correct(self, then: Base, measured: Floats, spread: Floats, common_m2: float = 0.0) -> None:
        """A measurement (3,) of x, y and heading of the base at some time, with its covariance (3, 3).

        common_m2: variance of the position of what it was measured against, which no number of measurements lowers.
        """
        mean_m2 = 0.5 * float(np.trace(self.covariance[:2, :2]))
        own = self.covariance * max(1.0 - common_m2 / max(mean_m2, 1e-12), MIN_OWN_SHARE)
        error = measured - then.planar_w
        error[2] = wrapped(error[2])
        gain = own @ np.linalg.inv(own + spread)
        by = gain @ error
        left = np.eye(3) - gain
        self.covariance = left @ own @ left.T + gain @ spread @ gain.T + np.diag([common_m2, common_m2, 0.0])
        self._shift(then.planar_w[:2], by)

    def correct_along(self, rows: Floats, errors_m: Floats, sds_m: Floats) -> None:
        """Measurements of now, each along one direction: rows (m, 3) say how it changes with x, y and heading.

        errors_m, sds_m: (m,) by how much it is greater than with the present base, and its standard deviation.
        """
        across = self.covariance @ rows.T
        gain = across @ np.linalg.inv(rows @ across + np.diag(sds_m**2))
        left = np.eye(3) - gain @ rows
        self.covariance = left @ self.covariance @ left.T + (gain * sds_m**2) @ gain.T
        self._shift(self.base.planar_w[:2].copy(), gain @ errors_m)

    def _shift(self, around: Floats, by: Floats) -> None:
        """Turn the base, and where it was, around a place (2,) by by[2], then move them by by[:2]."""
        now = self.base.planar_w
        moved = around + (about_z(by[2])[:2, :2] @ (now[:2] - around)) + by[:2]
        self.base = Base(np.array([*moved, wrapped(now[2] + by[2])]), self.base.z_m, self.base.tilt)
        self.history.move(around, by)

    def _plausible(self, error: Floats) -> bool:
        error = np.array([error[0], error[1], wrapped(error[2])])
        spread = self.covariance + np.diag(self._measured + np.square([0.005, 0.005, 0.01]))
        return float(error @ np.linalg.solve(spread, error)) < GATE

    def _go(self, step: Step) -> None:
        x, y, yaw = self.base.planar_w
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy, turn = step.by
        moved = np.array([x + c * dx - s * dy, y + s * dx + c * dy, wrapped(yaw + turn)])
        swept = np.array([[1.0, 0.0, -(s * dx + c * dy)], [0.0, 1.0, c * dx - s * dy], [0.0, 0.0, 1.0]])
        into = about_z(yaw)
        self.covariance = swept @ self.covariance @ swept.T + into @ step.covariance @ into.T
        self.base = Base(moved, self.base.z_m, self.base.tilt)

    def _level(self, imu: Imu) -> None:
        """What is level, by the tail link's accelerometer."""
        if 0 not in imu.link:
            return
        felt = np.array(imu.acceleration_m_s2[imu.link.index(0)])
        up = felt if self._up_b is None else self._up_b + (felt - self._up_b) * 0.02 / LEVEL_S
        self._up_b = up
        z = up / max(float(np.linalg.norm(up)), 1e-6)
        forward = np.array([1.0, 0.0, 0.0]) - z[0] * z
        x = forward / max(float(np.linalg.norm(forward)), 1e-6)
        tilt: Floats = np.array([x, np.cross(z, x), z], dtype=np.float64)  # rows: the level frame's axes in the base's
        self.base = Base(self.base.planar_w, self.base.z_m, tilt)


def _fresh(message: MessageT | None, joints: JointState) -> MessageT | None:
    """The message, if it is of about the time of the joint state."""
    return message if message is not None and abs(joints.timestamp_ns - message.timestamp_ns) <= FRESH_NS else None
