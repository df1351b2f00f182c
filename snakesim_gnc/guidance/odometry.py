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
from snakesim_hal.model.kinematics import link_frames
from snakesim_hal.wire.messages import Contact, Contacts, Description, Imu, JointState

# Standard deviations of speeds.
ALONG_NORMAL_SD_M_S = 0.005  # of a body along the normal of a contact
SIDEWAYS_SD_M_S = 0.02  # of a link at rest
SIDEWAYS_SD_M_PER_RAD = 0.02  # in addition, for each rad/s of the joints
STEP_SD_M_S = 0.005  # of the base at rest
STEP_SD_M_PER_RAD = 1.0  # in addition, for each rad/s of the joints
GYRO_SD_RAD_S = 0.01
TURN_SD_RAD_S = 1.0  # without a gyroscope

SLIP_S = 2.0  # time for which an error lasts
MAX_STEP_S = 0.2  # between two joint states; a step over a longer gap is only uncertain
GAP_SD = (0.3, 0.3, 1.0)  # standard deviations of such a step, in m/s and rad/s
MIN_HORIZONTAL = 0.5  # part of a normal in the plane of the ground: with less, the body lies on the obstacle


@dataclass(frozen=True)
class OdometryStep:
    """A step of the base, in its level frame before the step."""

    motion: Floats  # (3,) forward, left, turn
    covariance: Floats  # (3, 3), to be added to that of the pose


@dataclass(frozen=True)
class _Shape:
    """The links at one time, in the level frame of the base; n is their number."""

    timestamp_ns: int
    origins: Floats  # (n, 3)
    rotations: Floats  # (n, 3, 3)


class _Equations(NamedTuple):
    """Equations `rows @ step = values`."""

    rows: Floats  # (m, 3)
    values: Floats  # (m,)
    sds: Floats  # (m,) standard deviations


class Odometry:
    """Computes steps from joint state to joint state."""

    def __init__(self, robot: Description) -> None:
        self._axes = [joint.axis for joint in robot.joints]
        self._lengths = [link.length_m for link in robot.links]
        self._half_m = 0.5 * np.array(self._lengths)
        self._before: _Shape | None = None

    def step(self, joints: JointState, tilt: Floats, contacts: Contacts | None, imu: Imu | None) -> OdometryStep | None:
        """Estimate the motion of the base since the last call by weighted least squares.

        The equations say that the links slide along themselves and along the contacts, that the gyroscopes measure the
        turn, and that the base hardly moves while the joints rest.

        Args:
            joints: the joint state after the step.
            tilt: (3, 3) level_from_base.
            contacts: contacts of the links; None if there are no recent ones.
            imu: angular velocities; None if there are no recent ones.

        Returns:
            The step with its covariance; None at the first call, and if no time has passed.
        """
        origins, rotations = link_frames(np.zeros(3), tilt, joints.angle_rad, self._axes, self._lengths)
        now = _Shape(joints.timestamp_ns, origins, rotations)
        before = self._before
        if before is None:
            self._before = now
            return None
        if now.timestamp_ns <= before.timestamp_ns:
            return None
        self._before = now
        period_s = (now.timestamp_ns - before.timestamp_ns) * 1e-9
        if period_s > MAX_STEP_S:
            return OdometryStep(np.zeros(3), np.diag([sd * period_s for sd in GAP_SD]) ** 2)

        joint_rad_s = float(np.sqrt(np.mean(np.square(joints.velocity_rad_s))))
        equations = self._sliding_equations(before, now, joint_rad_s)
        if contacts is not None:
            at_contacts = _contact_equations(before, now, contacts.contacts)
            equations = _Equations(
                rows=np.concatenate([equations.rows, at_contacts.rows]),
                values=np.concatenate([equations.values, at_contacts.values]),
                sds=np.concatenate([equations.sds, at_contacts.sds]),
            )
        turn_rad, turn_sd_rad = _measure_turn(before, now, imu, period_s)
        still_sd_m = (STEP_SD_M_S + STEP_SD_M_PER_RAD * joint_rad_s) * period_s
        rows = np.vstack([equations.rows, np.eye(3)])
        values = np.concatenate([equations.values, [0.0, 0.0, turn_rad]])
        sds = np.concatenate([equations.sds * period_s, [still_sd_m, still_sd_m, turn_sd_rad]])

        information = rows.T @ (rows / np.square(sds)[:, None])
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        motion: Floats = covariance @ (rows.T @ (values / np.square(sds)))
        # Slip lasts for about SLIP_S, so the errors of successive steps are alike and their variances add up faster.
        step_covariance: Floats = covariance * (SLIP_S / period_s)
        if imu is not None:
            # The noise of gyroscopes is white, so the error of the turn does not last.
            turn_row = [0.0, 0.0, turn_sd_rad**2]
            step_covariance[2, :] = turn_row
            step_covariance[:, 2] = turn_row
        return OdometryStep(motion, step_covariance)

    def _sliding_equations(self, before: _Shape, now: _Shape, joint_rad_s: float) -> _Equations:
        """Return equations that no link's middle moves sideways; the standard deviations are speeds."""
        middles_before = before.origins + self._half_m[:, None] * before.rotations[:, :, 0]
        middles = now.origins + self._half_m[:, None] * now.rotations[:, :, 0]
        moved = (middles - middles_before)[:, :2]  # by the joints alone
        left = now.rotations[:, :2, 1]
        left = left / np.maximum(np.hypot(left[:, 0], left[:, 1]), 1e-6)[:, None]
        sd_m_s = SIDEWAYS_SD_M_S + SIDEWAYS_SD_M_PER_RAD * joint_rad_s
        return _Equations(
            rows=_step_rows(left, middles[:, :2]),
            values=-np.einsum("ij,ij->i", left, moved),
            sds=np.ones(len(moved)) * sd_m_s,
        )


def _contact_equations(before: _Shape, now: _Shape, contacts: Sequence[Contact]) -> _Equations:
    """Return equations that no contact moves along its normal; the standard deviations are speeds."""
    rows = [np.empty((0, 3))]
    values: list[float] = []
    for contact in contacts:
        link = contact.link
        position_l = np.array(contact.position_l)
        normal = (now.rotations[link] @ np.array(contact.normal_l))[:2]
        length = float(np.hypot(normal[0], normal[1]))
        if length < MIN_HORIZONTAL:
            continue
        normal = normal / length
        position = (now.origins[link] + now.rotations[link] @ position_l)[:2]
        position_before = (before.origins[link] + before.rotations[link] @ position_l)[:2]
        rows.append(_step_rows(normal[None], position[None]))
        values.append(-float(normal @ (position - position_before)))
    return _Equations(np.vstack(rows), np.array(values), np.full(len(values), ALONG_NORMAL_SD_M_S))


def _measure_turn(before: _Shape, now: _Shape, imu: Imu | None, period_s: float) -> tuple[float, float]:
    """Return the turn of the base by the gyroscopes, and its standard deviation, in rad."""
    if imu is None or not imu.link:
        return 0.0, TURN_SD_RAD_S * period_s
    turns_rad: list[float] = []
    for link, rate in zip(imu.link, imu.angular_velocity_rad_s, strict=True):
        rotation = now.rotations[link]
        relative = rotation @ before.rotations[link].T
        by_joints_rad = float(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))
        turn_rad = float((rotation @ np.array(rate))[2]) * period_s
        turns_rad.append(turn_rad - by_joints_rad)
    return float(np.mean(turns_rad)), GYRO_SD_RAD_S * period_s


def _step_rows(direction: Floats, points: Floats) -> Floats:
    """Return rows (n, 3): how a step (forward, left, turn) moves points (n, 2) along directions (n, 2)."""
    turning = direction[:, 1] * points[:, 0] - direction[:, 0] * points[:, 1]
    return np.column_stack([direction, turning])
