"""Estimates where the base is: dead reckoning, corrected by a pose sensor and by the map. Pure.

An extended Kalman filter of x, y and heading. A measurement is compared with where the base was at the timestamp of the
measurement, so a late one corrects what has happened since as well. A pose that jumps is rejected, unless it stays
where it jumped to.
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from snakesim_gnc.guidance.body_history import Base, BodyHistory, rotation_about_z, wrap_angle
from snakesim_gnc.guidance.odometry import Odometry, OdometryStep
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import rotation_from_quaternion, yaw_from_rotation
from snakesim_hal.wire.messages import Contacts, Description, Imu, JointState, Pose

MessageT = TypeVar("MessageT", Contacts, Imu)

# Standard deviations of x, y and heading, in m and rad.
MIN_POSE_SD = np.array([0.0005, 0.0005, 0.001])  # of a pose sensor, even if its file has smaller ones
START_SD = np.array([0.01, 0.01, 0.02])  # of the pose at which a robot without a pose sensor starts
GATE_SD = np.array([0.005, 0.005, 0.01])  # added before a pose is judged as implausible

# When a pose is believed.
GATE = 25.0  # squared Mahalanobis distance
JUMP_S = 0.3  # a pose that is rejected for longer than this is right: the robot was carried
JUMP_COVARIANCE = np.diag([1.0, 1.0, 1.0])  # after a jump
FIRST_COVARIANCE = np.diag([10.0, 10.0, 10.0])  # before the first pose, so that it counts alone

MIN_OWN_RATIO = 0.05  # of the variance that counts as the robot's own, not the map's
MAX_AGE_NS = 60_000_000  # contacts and gyroscope readings count for joint states within this time

# Leveling by the tail link's accelerometer.
LEVEL_S = 0.5  # time over which accelerations are averaged
LEVEL_PERIOD_S = 0.02  # between two readings


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of a pose sensor."""

    position_m: float = 0.001
    angle_rad: float = 0.002


class Localizer:
    """Estimates the base pose of one robot."""

    def __init__(self, robot: Description, start: Base, noise: PoseNoise) -> None:
        """Begin at the start pose. noise: of the pose sensor, if there is one."""
        # The estimate.
        self.base = start
        self.covariance = np.diag(START_SD**2)  # (3, 3) of x, y and heading
        self.history = BodyHistory(robot)
        self._odometry = Odometry(robot)
        self._up_b: Floats | None = None  # (3,) averaged specific force of the tail link

        # The pose sensor.
        self.pose_timestamp_ns: int | None = None  # of the newest pose that was believed
        self.refused = 0  # poses that were rejected
        self.carried_m = 0.0  # distance by which the newest pose showed that the robot was carried; 0: it was not
        self._refused_since_ns: int | None = None
        pose_sd = np.maximum([noise.position_m, noise.position_m, noise.angle_rad], MIN_POSE_SD)
        self._pose_variance = np.square(pose_sd)  # (3,)

    @property
    def position_sd_m(self) -> float:
        """Standard deviation of the position in the worst direction."""
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance[:2, :2])[-1]), 0.0))

    @property
    def yaw_sd_rad(self) -> float:
        """Standard deviation of the heading."""
        return math.sqrt(float(self.covariance[2, 2]))

    def move(self, joints: JointState, contacts: Contacts | None, imu: Imu | None) -> None:
        """Move the base by dead reckoning to a joint state."""
        if imu is not None and self.pose_timestamp_ns is None:
            self._level(imu)
        step = self._odometry.step(joints, self.base.tilt, _if_recent(contacts, joints), _if_recent(imu, joints))
        if step is not None:
            self._apply_step(step)
        self.history.add(joints.timestamp_ns, self.base, joints.angle_rad)

    def add_pose(self, pose: Pose) -> None:
        """Correct the estimated base pose by a sample of the pose sensor.

        The first sample replaces the estimate. A later one that is implausibly far from the estimate is rejected and
        counted in `refused`. If samples have been rejected for JUMP_S, the robot was probably moved: the sample then
        replaces the estimate, and `carried_m` is the distance. Repeated and outdated samples change nothing.

        Args:
            pose: the sample; it corrects the estimate of the time at which it was measured.
        """
        self.carried_m = 0.0
        is_first = self.pose_timestamp_ns is None
        if self.pose_timestamp_ns is not None and pose.timestamp_ns <= self.pose_timestamp_ns:
            return
        estimate_then = self.history.base_at(pose.timestamp_ns)
        if estimate_then is None:
            return
        rotation = rotation_from_quaternion(pose.orientation_wxyz)
        yaw_rad = yaw_from_rotation(rotation)
        measured_w = np.array([*pose.position_w[:2], yaw_rad])
        jump = measured_w - estimate_then.planar_w
        if is_first:
            self.covariance = FIRST_COVARIANCE.copy()
        elif not self._is_plausible(jump):
            self.refused += 1
            self._refused_since_ns = self._refused_since_ns or pose.timestamp_ns
            if pose.timestamp_ns - self._refused_since_ns < JUMP_S * 1e9:
                return
            self.carried_m = float(np.hypot(jump[0], jump[1]))
            self.covariance = JUMP_COVARIANCE.copy()
        self._refused_since_ns = None
        self.pose_timestamp_ns = pose.timestamp_ns
        self.base = Base(self.base.planar_w, pose.position_w[2], rotation_about_z(-yaw_rad) @ rotation)
        self.correct(estimate_then, measured_w, np.diag(self._pose_variance))

    def correct(
        self, estimate: Base, measured_w: Floats, measurement_covariance: Floats, common_m2: float = 0.0
    ) -> None:
        """Correct the base pose by a measurement of x, y and heading at some time (Kalman update, Joseph form).

        With P the covariance of the estimate, without the part that is common with the map, and R the covariance of
        the measurement, the gain is K = P (P + R)^-1, and P becomes (I - K) P (I - K)^T + K R K^T.

        Args:
            estimate: the estimate at the time of the measurement.
            measured_w: (3,) measured x and y in m, and heading in rad.
            measurement_covariance: (3, 3) covariance R of the measurement.
            common_m2: variance in m² of the position of the obstacles against which the pose was measured. It is added
                at the end, because no number of measurements lowers it.
        """
        mean_m2 = 0.5 * float(np.trace(self.covariance[:2, :2]))
        independent_ratio = max(1.0 - common_m2 / max(mean_m2, 1e-12), MIN_OWN_RATIO)
        independent = self.covariance * independent_ratio
        error = measured_w - estimate.planar_w
        error[2] = wrap_angle(error[2])
        gain = independent @ np.linalg.inv(independent + measurement_covariance)
        remaining = np.eye(3) - gain
        common_covariance = np.diag([common_m2, common_m2, 0.0])
        self.covariance = (
            remaining @ independent @ remaining.T + gain @ measurement_covariance @ gain.T + common_covariance
        )
        self._shift(estimate.planar_w[:2], gain @ error)

    def correct_along(self, rows: Floats, errors_m: Floats, sds_m: Floats) -> None:
        """Correct the base by m present measurements, each along one direction.

        Args:
            rows: (m, 3) how each measurement changes with x, y and heading.
            errors_m: (m,) by how much it is larger than by the present estimate.
            sds_m: (m,) its standard deviation.
        """
        across = self.covariance @ rows.T
        gain = across @ np.linalg.inv(rows @ across + np.diag(sds_m**2))
        rest = np.eye(3) - gain @ rows
        self.covariance = rest @ self.covariance @ rest.T + (gain * sds_m**2) @ gain.T
        self._shift(self.base.planar_w[:2].copy(), gain @ errors_m)

    def _shift(self, center_w: Floats, shift: Floats) -> None:
        """Turn the base and its history around a center (2,), then move them. shift: (3,) x, y, turn."""
        now = self.base.planar_w
        rotation = rotation_about_z(shift[2])[:2, :2]
        moved_w = center_w + (rotation @ (now[:2] - center_w)) + shift[:2]
        planar_w = np.array([*moved_w, wrap_angle(now[2] + shift[2])])
        self.base = Base(planar_w, self.base.z_m, self.base.tilt)
        self.history.shift(center_w, shift)

    def _is_plausible(self, jump: Floats) -> bool:
        """Return whether a difference (3,) between a measured pose and the estimate is within the noise."""
        error = np.array([jump[0], jump[1], wrap_angle(jump[2])])
        spread = self.covariance + np.diag(self._pose_variance + np.square(GATE_SD))
        return float(error @ np.linalg.solve(spread, error)) < GATE

    def _apply_step(self, step: OdometryStep) -> None:
        """Move the base pose by a step of the odometry, and propagate its covariance.

        With F and G the Jacobians of the new pose by the old pose and by the step, and Q the covariance of the step, P
        becomes F P F^T + G Q G^T.

        Args:
            step: motion forward, to the left and about the vertical axis in the frame of the base, with its covariance.
        """
        x, y, yaw_rad = self.base.planar_w
        forward, left, turn_rad = step.motion
        cosine = math.cos(yaw_rad)
        sine = math.sin(yaw_rad)
        planar_w = np.array(
            [
                x + cosine * forward - sine * left,
                y + sine * forward + cosine * left,
                wrap_angle(yaw_rad + turn_rad),
            ]
        )
        jacobian_by_pose = np.array(
            [
                [1.0, 0.0, -(sine * forward + cosine * left)],
                [0.0, 1.0, cosine * forward - sine * left],
                [0.0, 0.0, 1.0],
            ]
        )
        jacobian_by_step = rotation_about_z(yaw_rad)
        covariance_of_pose = jacobian_by_pose @ self.covariance @ jacobian_by_pose.T
        covariance_of_step = jacobian_by_step @ step.covariance @ jacobian_by_step.T
        self.covariance = covariance_of_pose + covariance_of_step
        self.base = Base(planar_w, self.base.z_m, self.base.tilt)

    def _level(self, imu: Imu) -> None:
        """Estimate the tilt of the base by the tail link's accelerometer: the mean specific force points up."""
        if 0 not in imu.link:
            return
        force_b = np.array(imu.acceleration_m_s2[imu.link.index(0)])
        if self._up_b is None:
            self._up_b = force_b
        else:
            self._up_b = self._up_b + (force_b - self._up_b) * LEVEL_PERIOD_S / LEVEL_S
        z = self._up_b / max(float(np.linalg.norm(self._up_b)), 1e-6)
        forward = np.array([1.0, 0.0, 0.0]) - z[0] * z
        x = forward / max(float(np.linalg.norm(forward)), 1e-6)
        tilt: Floats = np.array([x, np.cross(z, x), z], dtype=np.float64)  # rows: axes of the level frame in the base
        self.base = Base(self.base.planar_w, self.base.z_m, tilt)


def _if_recent(message: MessageT | None, joints: JointState) -> MessageT | None:
    """Return the message if it is of about the time of the joint state, else None."""
    if message is None or abs(joints.timestamp_ns - message.timestamp_ns) > MAX_AGE_NS:
        return None
    return message
