"""Estimates where the base is: dead reckoning, corrected by a pose sensor and by the map. Pure.

An extended Kalman filter of x, y and heading. A measurement is compared with where the base was at the timestamp of the
measurement, so a late one corrects what has happened since as well. A pose that jumps is rejected, unless it stays
where it jumped to.
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from snakesim_gnc.guidance.pose.body_history import (
    BasePose,
    BodyHistory,
    make_rotation_about_z,
    wrap_angle,
)
from snakesim_gnc.guidance.pose.odometry import ChainOdometry, OdometryStep
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion, yaw_from_rotation
from snakesim_hal.wire.messages import Contacts, Imu, JointState, Pose, RobotDescription

MessageT = TypeVar("MessageT", Contacts, Imu)

# Standard deviations of x, y and heading, in m and rad.
# Of a pose sensor, even if its file has smaller ones.
MIN_POSE_SD = np.array([0.0005, 0.0005, 0.001])
START_SD = np.array([0.01, 0.01, 0.02])  # of the pose at which a robot without a pose sensor starts
# Added before a pose is judged as implausible.
PLAUSIBILITY_MARGIN_SD = np.array([0.005, 0.005, 0.01])

# When a pose is believed.
MAX_SQUARED_MAHALANOBIS_DISTANCE = 25.0  # squared Mahalanobis distance
JUMP_TIMEOUT_S = 0.3  # a pose that is rejected for longer than this is right: the robot was carried
JUMP_COVARIANCE = np.diag([1.0, 1.0, 1.0])  # after a jump
FIRST_COVARIANCE = np.diag([10.0, 10.0, 10.0])  # before the first pose, so that it counts alone

MIN_INDEPENDENT_RATIO = 0.05  # of the variance that counts as the robot's own, not the map's
MAX_AGE_NS = 60_000_000  # contacts and gyroscope readings count for joint states within this time

# Leveling by the tail link's accelerometer.
TILT_FILTER_TIME_CONSTANT_S = 0.5  # time over which accelerations are averaged
IMU_PERIOD_S = 0.02  # between two readings
HALF_CONFIDENCE_SD_M = 0.05  # of the position, at which the confidence in it is one half
MIN_NORM = 1e-6  # of a vector that is normalized; avoids a division by zero


def compute_confidence(position_sd_m: float) -> float:
    """Return the confidence in a position, 0 to 1, by its standard deviation."""
    return 1.0 / (1.0 + (position_sd_m / HALF_CONFIDENCE_SD_M) ** 2)


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of a pose sensor."""

    position_m: float = 0.001
    angle_rad: float = 0.002


class PoseLocalizer:
    """Estimates the base pose of one robot."""

    def __init__(self, robot: RobotDescription, start: BasePose, noise: PoseNoise) -> None:
        """Create an estimator of the base pose that starts at a known pose.

        Args:
            robot: Description of the robot.
            start: Base pose at the start.
            noise: Noise of the pose sensor, if there is one.
        """
        # The estimate.
        self.base = start
        self.covariance = np.diag(START_SD**2)  # (3, 3) of x, y and heading
        self.history = BodyHistory(robot)
        self._odometry = ChainOdometry(robot)
        # (3,) averaged specific force of the tail link.
        self._mean_specific_force_b: Floats | None = None

        # The pose sensor.
        self.pose_timestamp_ns: int | None = None  # of the newest pose that was accepted
        self.rejected_pose_count = 0
        # By which the newest pose showed that the robot was carried; 0 if it was not.
        self.jump_distance_m = 0.0
        self._rejected_since_ns: int | None = None
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

    def predict(self, joints: JointState, contacts: Contacts | None, imu: Imu | None) -> None:
        """Predict the base pose at a joint state by dead reckoning, and store it in the history.

        Args:
            joints: The new joint state.
            contacts: The newest contacts; used only if they are recent. None if there are none.
            imu: The newest IMU readings; used only if they are recent. None if there are none.
        """
        if imu is not None and self.pose_timestamp_ns is None:
            self._update_tilt(imu)
        step = self._odometry.estimate_step(
            joints, self.base.tilt, _discard_if_old(contacts, joints), _discard_if_old(imu, joints)
        )
        if step is not None:
            self._apply_odometry_step(step)
        self.history.add(joints.timestamp_ns, self.base, joints.angle_rad)

    def add_pose(self, pose: Pose) -> None:
        """Correct the estimated base pose by a sample of the pose sensor.

        The first sample replaces the estimate. A later one that is implausibly far from the estimate is rejected and
        counted in `rejected_pose_count`. If samples have been rejected for JUMP_TIMEOUT_S, a person has probably
        carried the robot: the sample then replaces the estimate, and `jump_distance_m` is the distance. Repeated and
        outdated samples change nothing.

        Args:
            pose: The sample; it corrects the estimate of the time at which it was measured.
        """
        self.jump_distance_m = 0.0
        is_first = self.pose_timestamp_ns is None
        if self.pose_timestamp_ns is not None and pose.timestamp_ns <= self.pose_timestamp_ns:
            return
        estimate_then = self.history.interpolate_base(pose.timestamp_ns)
        if estimate_then is None:
            return
        rotation = rotation_from_quaternion(pose.orientation_wxyz)
        yaw_rad = yaw_from_rotation(rotation)
        measured_w = np.array([*pose.position_w[:2], yaw_rad])
        jump = measured_w - estimate_then.planar_w
        if is_first:
            self.covariance = FIRST_COVARIANCE.copy()
        elif not self._is_plausible_jump(jump):
            self.rejected_pose_count += 1
            self._rejected_since_ns = self._rejected_since_ns or pose.timestamp_ns
            if pose.timestamp_ns - self._rejected_since_ns < JUMP_TIMEOUT_S * 1e9:
                return
            self.jump_distance_m = float(np.hypot(jump[0], jump[1]))
            self.covariance = JUMP_COVARIANCE.copy()
        self._rejected_since_ns = None
        self.pose_timestamp_ns = pose.timestamp_ns
        self.base = BasePose(
            self.base.planar_w, pose.position_w[2], make_rotation_about_z(-yaw_rad) @ rotation
        )
        self.correct_by_pose(estimate_then, measured_w, np.diag(self._pose_variance))

    def correct_by_pose(
        self,
        estimate: BasePose,
        measured_w: Floats,
        measurement_covariance: Floats,
        map_variance_m2: float = 0.0,
    ) -> None:
        """Correct the base pose by a measurement of x, y and heading at some time (Kalman update, Joseph form).

        With P the covariance of the estimate, without the part that is common with the map, and R the covariance of
        the measurement, the gain is K = P (P + R)^-1, and P becomes (I - K) P (I - K)^T + K R K^T.

        Args:
            estimate: The estimate at the time of the measurement.
            measured_w: (3,) measured x and y in m, and heading in rad.
            measurement_covariance: (3, 3) covariance R of the measurement.
            map_variance_m2: Variance in m² of the position of the obstacles against which the pose was measured. It is
                added at the end, because no number of measurements lowers it.
        """
        # P: the covariance without the part that is common with the map.
        mean_variance_m2 = 0.5 * float(np.trace(self.covariance[:2, :2]))
        independent_ratio = max(
            1.0 - map_variance_m2 / max(mean_variance_m2, 1e-12), MIN_INDEPENDENT_RATIO
        )
        independent_covariance = self.covariance * independent_ratio

        # The innovation, (3,), and the update.
        pose_error = measured_w - estimate.planar_w
        pose_error[2] = wrap_angle(pose_error[2])
        kalman_gain = independent_covariance @ np.linalg.inv(
            independent_covariance + measurement_covariance
        )
        remaining = np.eye(3) - kalman_gain
        map_covariance = np.diag([map_variance_m2, map_variance_m2, 0.0])
        self.covariance = (
            remaining @ independent_covariance @ remaining.T
            + kalman_gain @ measurement_covariance @ kalman_gain.T
            + map_covariance
        )
        self._shift_base_and_history(estimate.planar_w[:2], kalman_gain @ pose_error)

    def correct_by_linear_measurements(self, rows: Floats, errors_m: Floats, sds_m: Floats) -> None:
        """Correct the current base pose by m linear measurements of x, y and heading (Kalman update).

        Args:
            rows: (m, 3) derivatives of each measurement by x, y and heading.
            errors_m: (m,) differences between each measurement and its value for the estimate.
            sds_m: (m,) standard deviations of the measurements.
        """
        cross_covariance = self.covariance @ rows.T
        kalman_gain = cross_covariance @ np.linalg.inv(rows @ cross_covariance + np.diag(sds_m**2))
        remaining = np.eye(3) - kalman_gain @ rows
        self.covariance = (
            remaining @ self.covariance @ remaining.T + (kalman_gain * sds_m**2) @ kalman_gain.T
        )
        self._shift_base_and_history(self.base.planar_w[:2].copy(), kalman_gain @ errors_m)

    def _shift_base_and_history(self, center_w: Floats, shift: Floats) -> None:
        """Rotate and translate the base and all poses of its history.

        Args:
            center_w: (2,) point about which the poses are rotated, m.
            shift: (3,) translation in x and y in m, and rotation in rad.
        """
        now = self.base.planar_w
        rotation = make_rotation_about_z(shift[2])[:2, :2]
        moved_w = center_w + (rotation @ (now[:2] - center_w)) + shift[:2]
        planar_w = np.array([*moved_w, wrap_angle(now[2] + shift[2])])
        self.base = BasePose(planar_w, self.base.z_m, self.base.tilt)
        self.history.shift_all_poses(center_w, shift)

    def _is_plausible_jump(self, jump: Floats) -> bool:
        """Return whether a difference (3,) between a measured and the estimated pose is within the noise.

        It is if the squared Mahalanobis distance is below MAX_SQUARED_MAHALANOBIS_DISTANCE.
        """
        error = np.array([jump[0], jump[1], wrap_angle(jump[2])])
        spread = self.covariance + np.diag(self._pose_variance + np.square(PLAUSIBILITY_MARGIN_SD))
        return float(error @ np.linalg.solve(spread, error)) < MAX_SQUARED_MAHALANOBIS_DISTANCE

    def _apply_odometry_step(self, step: OdometryStep) -> None:
        """Move the base pose by a step of the odometry, and propagate its covariance.

        With F and G the Jacobians of the new pose by the old pose and by the step, and Q the covariance of the step, P
        becomes F P F^T + G Q G^T.

        Args:
            step: Motion forward, to the left and about the vertical axis in the frame of the base, with its covariance.
        """
        x, y, yaw_rad = self.base.planar_w
        forward_m, left_m, rotation_rad = step.motion
        cosine = math.cos(yaw_rad)
        sine = math.sin(yaw_rad)
        planar_w = np.array(
            [
                x + cosine * forward_m - sine * left_m,
                y + sine * forward_m + cosine * left_m,
                wrap_angle(yaw_rad + rotation_rad),
            ]
        )
        jacobian_by_pose = np.array(
            [
                [1.0, 0.0, -(sine * forward_m + cosine * left_m)],
                [0.0, 1.0, cosine * forward_m - sine * left_m],
                [0.0, 0.0, 1.0],
            ]
        )
        jacobian_by_step = make_rotation_about_z(yaw_rad)
        covariance_of_pose = jacobian_by_pose @ self.covariance @ jacobian_by_pose.T
        covariance_of_step = jacobian_by_step @ step.covariance @ jacobian_by_step.T
        self.covariance = covariance_of_pose + covariance_of_step
        self.base = BasePose(planar_w, self.base.z_m, self.base.tilt)

    def _update_tilt(self, imu: Imu) -> None:
        """Update the tilt of the base by the accelerometer of the tail link: the mean specific force points up.

        Without readings of the tail link nothing changes.
        """
        if 0 not in imu.link:
            return
        # Low-pass filter of the first order.
        force_b = np.array(imu.acceleration_m_s2[imu.link.index(0)])
        mean_b = force_b
        if self._mean_specific_force_b is not None:
            change_b = force_b - self._mean_specific_force_b
            mean_b = (
                self._mean_specific_force_b + change_b * IMU_PERIOD_S / TILT_FILTER_TIME_CONSTANT_S
            )
        self._mean_specific_force_b = mean_b

        # Axes of the level frame in the base: z is up, and x is the forward axis of the base without its vertical part.
        z = mean_b / max(float(np.linalg.norm(mean_b)), MIN_NORM)
        forward = np.array([1.0, 0.0, 0.0]) - z[0] * z
        x = forward / max(float(np.linalg.norm(forward)), MIN_NORM)
        y = np.cross(z, x)
        tilt: Floats = np.array([x, y, z], dtype=np.float64)
        self.base = BasePose(self.base.planar_w, self.base.z_m, tilt)


def _discard_if_old(message: MessageT | None, joints: JointState) -> MessageT | None:
    """Return a message if its timestamp is at most MAX_AGE_NS from that of the joint state, and None otherwise."""
    if message is None or abs(joints.timestamp_ns - message.timestamp_ns) > MAX_AGE_NS:
        return None
    return message
