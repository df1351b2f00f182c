"""Collects what encoders, motors, IMUs and motion capture measured in a run of the joint check, tick by tick."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion
from snakesim_hal.model.robot_file.joints import JointDrive, JointMotor
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import Imu, RobotDescription
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.run_log import RunRecord

SIGNAL_NAMES = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "orientation_wxyz")
MIN_TARGET_MOTION_RAD = 1e-6  # a target that is further from its rest moves its joint
# Of the largest step from the measured angle; beyond, the command limiter set the target.
CLAMPED_FRACTION = 0.9
SMALL_MOTION_SPEED_RATIO = 0.5  # of the fastest motion of a joint; a slower one is a small motion
PITCH = 1  # y, component of a vector in a link's frame
YAW = 2  # z
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CheckMeasurements:
    """The measurements of a run of the joint check; rows are ticks."""

    period_s: float
    joint_names: Sequence[str]
    axes: Sequence[str]  # "yaw" or "pitch"
    drives: Sequence[JointDrive]  # from the robot file
    motors: Sequence[JointMotor]  # from the robot file
    link_lengths_m: Sequence[float]  # from the robot file
    link_masses_kg: Sequence[
        float
    ]  # from the robot file, without weights that a person laid on the links
    angle_rad: Floats  # (n, joints)
    velocity_rad_s: Floats  # (n, joints)
    torque_nm: Floats  # (n, joints)
    target_rad: Floats  # (n, joints)
    link_rate_rad_s: Floats  # (n, links, 3), in the link's frame; NaN where no IMU reported
    # (n, links, 3): specific force, in the link's frame; at rest 1 g upwards.
    link_force_m_s2: Floats
    # (n, 3): integral of link 0's rate, in its frame; NaN without motion capture.
    base_rotation_rad: Floats

    def is_moved_by_target(self, joint_index: int) -> Mask:
        """Return the ticks in which the joint's target is away from its rest, (n,)."""
        target_rad = self.target_rad[:, joint_index]
        return np.abs(target_rad - np.median(target_rad)) > MIN_TARGET_MOTION_RAD

    def is_in_large_motion(self, joint_index: int) -> Mask:
        """Return the ticks of the joint's large motions, (n,)."""
        return self._select_motions(joint_index, is_small=False)

    def is_in_small_motion(self, joint_index: int) -> Mask:
        """Return the ticks of the joint's small motions, (n,); none in recordings without them."""
        return self._select_motions(joint_index, is_small=True)

    def list_motions(self, joint_index: int) -> list[slice]:
        """Return the ticks of each motion of the joint away from its rest and back, in order."""
        is_moved = np.concatenate(([False], self.is_moved_by_target(joint_index), [False]))
        edges = np.flatnonzero(np.diff(is_moved.astype(np.int8)))
        return [slice(start, end) for start, end in edges.reshape(-1, 2).tolist()]

    def find_second_small_cycle(self, joint_index: int) -> slice | None:
        """Return the ticks of the joint's second small motion to both sides; None without any.

        The first one has moved the link to the middle of its backlash.
        """
        is_small = self.is_in_small_motion(joint_index)
        small_motions = [
            motion for motion in self.list_motions(joint_index) if is_small[motion.start]
        ]
        if len(small_motions) < 2:
            return None
        second_cycle = small_motions[len(small_motions) // 2 :]
        return slice(second_cycle[0].start, second_cycle[-1].stop)

    def _select_motions(self, joint_index: int, *, is_small: bool) -> Mask:
        """Return the ticks of the small or of the large motions. In small ones, the target moves slowly."""
        steps_rad = np.abs(np.diff(self.target_rad[:, joint_index], prepend=np.nan))
        motions = self.list_motions(joint_index)
        speeds = [float(np.nanmedian(steps_rad[motion])) for motion in motions]
        max_small_speed = SMALL_MOTION_SPEED_RATIO * max(speeds, default=0.0)
        selected = np.zeros(len(steps_rad), dtype=np.bool_)
        for motion, speed in zip(motions, speeds, strict=True):
            if (speed < max_small_speed) == is_small:
                selected[motion] = True
        return selected

    def is_at_rest(self) -> Mask:
        """Return the ticks in which no joint's target is away from its rest, (n,)."""
        moved = [self.is_moved_by_target(joint) for joint in range(len(self.joint_names))]
        return ~np.logical_or.reduce(moved)

    def is_before_motion(self) -> Mask:
        """Return the ticks before the first joint is moved, (n,)."""
        return np.logical_and.accumulate(self.is_at_rest())

    def measure_motion_range_rad(self, joint_index: int) -> float:
        """Return how far the joint moved by its encoder, from end to end."""
        moved = self.is_in_large_motion(joint_index)
        if not moved.any():
            return 0.0
        return float(np.ptp(self.angle_rad[moved, joint_index]))

    def find_axis_component(self, joint_index: int) -> int:
        """Return which component of a vector in a link's frame is about the joint's axis."""
        return YAW if self.axes[joint_index] == "yaw" else PITCH


def read_imus(record: RunRecord) -> Iterable[Imu]:
    """Yield every IMU message of a run. Raises ConfigError."""
    if record.recording_path is None:
        return
    decoder = MessageDecoder(Imu)
    for message in RecordingReader(record.recording_path).read_messages([keys.IMU]):
        yield decoder.decode(message.payload, message.encoding)


def compute_tick_numbers(time_s: Floats, rate_hz: float) -> list[int]:
    """Return the tick number of every row of a run log.

    Args:
        time_s: Robot time of each row, (n,).
        rate_hz: Ticks per second of the run.
    """
    return np.round(time_s * rate_hz).astype(int).tolist()


def arrange_imus_by_tick(
    imus: Iterable[Imu], ticks: Sequence[int], link_count: int
) -> tuple[Floats, Floats]:
    """Return angular rates and specific forces of the links, both (n, links, 3); NaN where no IMU reported."""
    row_by_tick = {tick: row for row, tick in enumerate(ticks)}
    rates_rad_s = np.full((len(ticks), link_count, 3), np.nan)
    forces_m_s2 = np.full((len(ticks), link_count, 3), np.nan)
    for imu in imus:
        row = row_by_tick.get(imu.tick)
        if row is not None:
            rates_rad_s[row, imu.link] = imu.angular_velocity_rad_s
            forces_m_s2[row, imu.link] = imu.acceleration_m_s2
    return rates_rad_s, forces_m_s2


def collect_measurements(
    config: RunConfig,
    robot: RobotDescription,
    ticks: Sequence[int],
    columns: Mapping[str, Floats],
    imus: Iterable[Imu],
) -> CheckMeasurements:
    """Collect what joints, IMUs and motion capture measured in a run of the joint check, one row for each tick.

    Args:
        config: Configuration of the run.
        robot: Description of the robot.
        ticks: Tick number of every row.
        columns: Recorded signals by name, such as `angle_rad`, each with one row for each tick.
        imus: Every IMU message of the run.

    Returns:
        The measurements; poses are moved to the ticks at which they were true, and targets that the command limiter
        changed are replaced.
    """
    link_rates_rad_s, link_forces_m_s2 = arrange_imus_by_tick(imus, ticks, len(robot.links))
    pose_sensor = config.robot.sensors.pose
    delay_ticks = 0
    if pose_sensor is not None:
        delay_ticks = round(pose_sensor.delay_s * config.rate_hz)
    # Move each pose to the tick at which it was true. The last ticks have none.
    orientations_wxyz = np.full_like(columns["orientation_wxyz"], np.nan)
    orientations_wxyz[: len(orientations_wxyz) - delay_ticks] = columns["orientation_wxyz"][
        delay_ticks:
    ]
    target_rad = remove_clamped_targets(
        columns["target"], columns["angle_rad"], config.robot.safety.max_step_rad
    )
    return CheckMeasurements(
        period_s=config.period_ns * 1e-9,
        joint_names=[joint.name for joint in robot.joints],
        axes=[joint.axis for joint in robot.joints],
        drives=[joint.drive for joint in config.robot.joint_table],
        motors=[joint.motor for joint in config.robot.joint_table],
        link_lengths_m=config.robot.link_lengths_m,
        link_masses_kg=config.robot.link_masses_kg,
        angle_rad=columns["angle_rad"],
        velocity_rad_s=columns["velocity_rad_s"],
        torque_nm=columns["torque_nm"],
        target_rad=target_rad,
        link_rate_rad_s=link_rates_rad_s,
        link_force_m_s2=link_forces_m_s2,
        base_rotation_rad=_integrate_base_rate(orientations_wxyz),
    )


def remove_clamped_targets(target_rad: Floats, angle_rad: Floats, max_step_rad: float) -> Floats:
    """Replace the targets that the command limiter changed by the joint's target at rest, and return all, (n, joints).

    A joint without current is swung by the motion of other joints. Once it is `max_step_rad` away from its target, the
    limiter moves the target along with the joint, which is no motion of the check.
    """
    is_clamped = np.abs(target_rad - angle_rad) > CLAMPED_FRACTION * max_step_rad
    at_rest_rad = np.nanmedian(np.where(is_clamped, np.nan, target_rad), axis=0)
    return np.where(is_clamped, at_rest_rad, target_rad)


def _integrate_base_rate(orientation_wxyz: Floats) -> Floats:
    """Integrate the base's angular rate in its own frame from the first known orientation on, (n, 3) in rad.

    A gyro on the base would measure that rate. A rotation from the first orientation would not be about the axis of a
    joint any more once the body has rolled, as a straight body on a flat floor does. The rotation from one orientation
    to the next is small, so its vector is the antisymmetric part of its matrix.
    """
    integral_rad = np.full((len(orientation_wxyz), 3), np.nan)
    is_known = np.isfinite(orientation_wxyz).all(axis=1) & (
        np.abs(orientation_wxyz).sum(axis=1) > 0
    )
    known_rows = np.flatnonzero(is_known)
    if not len(known_rows):
        return integral_rad
    rotation_rad = np.zeros(3)
    previous_rotation = rotation_from_quaternion(orientation_wxyz[known_rows[0]])
    for row in known_rows:
        current_rotation = rotation_from_quaternion(orientation_wxyz[row])
        rotation_step = previous_rotation.T @ current_rotation
        doubled_step_rad = np.array(
            (
                rotation_step[2, 1] - rotation_step[1, 2],
                rotation_step[0, 2] - rotation_step[2, 0],
                rotation_step[1, 0] - rotation_step[0, 1],
            )
        )
        rotation_rad = rotation_rad + doubled_step_rad / 2
        integral_rad[row] = rotation_rad
        previous_rotation = current_rotation
    return integral_rad
