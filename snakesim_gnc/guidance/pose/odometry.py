"""Dead reckoning: estimates how the base moved between two joint states, from joints, contacts and gyroscopes. Pure.

The joints give the change of shape. Three unknowns are left: the step of the base on the ground, (forward, left, turn)
in its level frame before the step. What is known of it:

gyroscopes  the turn of each link, less the joints' part of it
contacts    a body that slides along an obstacle does not move along the normal
links       they slide along themselves rather than sideways, the less so the faster the joints turn
stillness   without joint speed a snake does not move

Each of these is a row a of a linear equation a . step = value, with a standard deviation. Weighted least squares gives
the step and its covariance. Slip is not white noise: its errors last for seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_link_frames
from snakesim_hal.wire.messages import Contact, Contacts, Imu, JointState, RobotDescription

# Standard deviations of speeds.
ALONG_NORMAL_SD_M_S = 0.005  # of a body along the normal of a contact
SIDEWAYS_SD_M_S = 0.02  # of a link at rest
SIDEWAYS_SD_M_PER_RAD = 0.02  # in addition, for each rad/s of the joints
STEP_SD_M_S = 0.005  # of the base at rest
STEP_SD_M_PER_RAD = 1.0  # in addition, for each rad/s of the joints
GYRO_SD_RAD_S = 0.01
ROTATION_SD_WITHOUT_GYRO_RAD_S = 1.0  # without a gyroscope

SLIP_CORRELATION_TIME_S = 2.0  # time for which an error lasts
MAX_STEP_DURATION_S = 0.2  # between two joint states; a step over a longer gap is only uncertain
GAP_SD_PER_S = (0.3, 0.3, 1.0)  # standard deviations of such a step, in m/s and rad/s
# Part of a normal in the plane of the ground: with less, the body lies on the obstacle.
MIN_HORIZONTAL_NORMAL_PART = 0.5


@dataclass(frozen=True)
class OdometryStep:
    """Displacement of the base between two joint states, in the level frame of the base before the step."""

    motion: Floats  # (3,) forward in m, left in m, rotation about the vertical axis in rad
    covariance: Floats  # (3, 3), to be added to that of the pose


@dataclass(frozen=True)
class _LinkFrames:
    """The links at one time, in the level frame of the base; n is their number."""

    timestamp_ns: int
    origins: Floats  # (n, 3)
    rotations: Floats  # (n, 3, 3)


class _MotionEquations(NamedTuple):
    """Linear equations `rows @ motion = values` for the motion of the base."""

    rows: Floats  # (m, 3)
    values: Floats  # (m,)
    standard_deviations: Floats  # (m,) standard deviations


class ChainOdometry:
    """Computes steps from joint state to joint state."""

    def __init__(self, robot: RobotDescription) -> None:
        self._axes = [joint.axis for joint in robot.joints]
        self._link_lengths_m = [link.length_m for link in robot.links]
        self._half_lengths_m = 0.5 * np.array(self._link_lengths_m)
        self._previous_frames: _LinkFrames | None = None

    def estimate_step(
        self, joints: JointState, tilt: Floats, contacts: Contacts | None, imu: Imu | None
    ) -> OdometryStep | None:
        """Estimate the motion of the base since the last call by weighted least squares, and store the joint state.

        The equations say that the links slide along themselves and along the contacts, that the gyroscopes measure the
        rotation, and that the base hardly moves while the joints rest. After a gap of more than MAX_STEP_DURATION_S the
        motion is zero, with a large covariance.

        Args:
            joints: The joint state after the step.
            tilt: (3, 3) rotation matrix level_from_base.
            contacts: Contacts of the links; None if there are no recent ones.
            imu: Angular velocities of some links; None if there are no recent ones.

        Returns:
            The step with its covariance; None at the first call, and if the joint state is not newer than the last one.
        """
        origins, rotations = compute_link_frames(
            np.zeros(3), tilt, joints.angle_rad, self._axes, self._link_lengths_m
        )
        current = _LinkFrames(joints.timestamp_ns, origins, rotations)
        previous = self._previous_frames
        if previous is None:
            self._previous_frames = current
            return None
        if current.timestamp_ns <= previous.timestamp_ns:
            return None
        self._previous_frames = current
        period_s = (current.timestamp_ns - previous.timestamp_ns) * 1e-9
        if period_s > MAX_STEP_DURATION_S:
            return OdometryStep(np.zeros(3), np.diag([sd * period_s for sd in GAP_SD_PER_S]) ** 2)

        rms_joint_velocity_rad_s = float(np.sqrt(np.mean(np.square(joints.velocity_rad_s))))
        equations = self._make_sliding_equations(previous, current, rms_joint_velocity_rad_s)
        if contacts is not None:
            contact_equations = _make_contact_equations(previous, current, contacts.contacts)
            equations = _MotionEquations(
                rows=np.concatenate([equations.rows, contact_equations.rows]),
                values=np.concatenate([equations.values, contact_equations.values]),
                standard_deviations=np.concatenate(
                    [equations.standard_deviations, contact_equations.standard_deviations]
                ),
            )
        # Three more equations: the base hardly moves forward or to the left, and turns as the gyroscopes measure.
        rotation_rad, rotation_sd_rad = _measure_base_rotation(previous, current, imu, period_s)
        translation_sd_m = (STEP_SD_M_S + STEP_SD_M_PER_RAD * rms_joint_velocity_rad_s) * period_s
        rows = np.vstack([equations.rows, np.eye(3)])
        values = np.concatenate([equations.values, [0.0, 0.0, rotation_rad]])
        standard_deviations = np.concatenate(
            [
                equations.standard_deviations * period_s,
                [translation_sd_m, translation_sd_m, rotation_sd_rad],
            ]
        )

        # Weighted least squares for the motion of the base: forward, left and rotation.
        information = rows.T @ (rows / np.square(standard_deviations)[:, None])
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        motion: Floats = covariance @ (rows.T @ (values / np.square(standard_deviations)))
        # Slip lasts for about SLIP_CORRELATION_TIME_S. So the errors of successive steps are alike, and their variances
        # add up faster.
        step_covariance: Floats = covariance * (SLIP_CORRELATION_TIME_S / period_s)
        if imu is not None:
            # The noise of gyroscopes is white, so the error of the turn does not last.
            rotation_row = [0.0, 0.0, rotation_sd_rad**2]
            step_covariance[2, :] = rotation_row
            step_covariance[:, 2] = rotation_row
        return OdometryStep(motion, step_covariance)

    def _make_sliding_equations(
        self, previous: _LinkFrames, current: _LinkFrames, rms_joint_velocity_rad_s: float
    ) -> _MotionEquations:
        """Make the equations that the middles of the links do not move sideways.

        Args:
            previous: Frames of the links before the step.
            current: Frames of the links after the step.
            rms_joint_velocity_rad_s: Root mean square of the joint velocities; the faster, the less certain.

        Returns:
            One equation for each link. The standard deviations are speeds in m/s.
        """
        middles_before = (
            previous.origins + self._half_lengths_m[:, None] * previous.rotations[:, :, 0]
        )
        middles = current.origins + self._half_lengths_m[:, None] * current.rotations[:, :, 0]
        moved = (middles - middles_before)[:, :2]  # by the joints alone
        left = current.rotations[:, :2, 1]
        left = left / np.maximum(np.hypot(left[:, 0], left[:, 1]), 1e-6)[:, None]
        sd_m_s = SIDEWAYS_SD_M_S + SIDEWAYS_SD_M_PER_RAD * rms_joint_velocity_rad_s
        return _MotionEquations(
            rows=_make_step_rows(left, middles[:, :2]),
            values=-np.einsum("ij,ij->i", left, moved),
            standard_deviations=np.ones(len(moved)) * sd_m_s,
        )


def _make_contact_equations(
    previous: _LinkFrames, current: _LinkFrames, contacts: Sequence[Contact]
) -> _MotionEquations:
    """Make the equations that no contact moves along its normal.

    Contacts whose normal is nearly vertical are left out, because the body lies on those obstacles.

    Args:
        previous: Frames of the links before the step.
        current: Frames of the links after the step.
        contacts: Contacts of the links, in the frames of the links.

    Returns:
        One equation for each contact that is used. The standard deviations are speeds in m/s.
    """
    rows = [np.empty((0, 3))]
    values: list[float] = []
    for contact in contacts:
        link = contact.link
        position_l = np.array(contact.position_l)
        normal = (current.rotations[link] @ np.array(contact.normal_l))[:2]
        length = float(np.hypot(normal[0], normal[1]))
        if length < MIN_HORIZONTAL_NORMAL_PART:
            continue
        normal = normal / length
        position = (current.origins[link] + current.rotations[link] @ position_l)[:2]
        position_before = (previous.origins[link] + previous.rotations[link] @ position_l)[:2]
        rows.append(_make_step_rows(normal[None], position[None]))
        values.append(-float(normal @ (position - position_before)))
    return _MotionEquations(
        np.vstack(rows), np.array(values), np.full(len(values), ALONG_NORMAL_SD_M_S)
    )


def _measure_base_rotation(
    previous: _LinkFrames, current: _LinkFrames, imu: Imu | None, period_s: float
) -> tuple[float, float]:
    """Measure the rotation of the base about the vertical axis by the gyroscopes of the links.

    The rotation that the joints cause is subtracted from what each gyroscope measures.

    Args:
        previous: Frames of the links before the step.
        current: Frames of the links after the step.
        imu: Angular velocities of some links; None or without links if nothing is measured.
        period_s: Duration of the step.

    Returns:
        The rotation in rad and its standard deviation in rad; 0 with a large standard deviation without gyroscopes.
    """
    if imu is None or not imu.link:
        return 0.0, ROTATION_SD_WITHOUT_GYRO_RAD_S * period_s
    rotations_rad: list[float] = []
    for link, rate in zip(imu.link, imu.angular_velocity_rad_s, strict=True):
        rotation = current.rotations[link]
        relative = rotation @ previous.rotations[link].T
        by_joints_rad = float(
            np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1])
        )
        rotation_rad = float((rotation @ np.array(rate))[2]) * period_s
        rotations_rad.append(rotation_rad - by_joints_rad)
    return float(np.mean(rotations_rad)), GYRO_SD_RAD_S * period_s


def _make_step_rows(direction: Floats, points: Floats) -> Floats:
    """Return the coefficients of the motion of points along directions, as functions of the motion of the base.

    Args:
        direction: (n, 2) unit vectors.
        points: (n, 2) points in the level frame of the base, m.

    Returns:
        (n, 3) coefficients of forward, left and rotation.
    """
    turning = direction[:, 1] * points[:, 0] - direction[:, 0] * points[:, 1]
    return np.column_stack([direction, turning])
