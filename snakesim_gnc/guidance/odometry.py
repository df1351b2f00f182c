"""Dead reckoning: how the base moved between two joint states, from joints, contacts and gyros. Pure.

The joints give the change of shape; three unknowns are left, the base's step on the ground. What is known of it:

gyros      the turn of each link, less the joints' part of it
contacts   a body that slides along an obstacle does not move along the normal (sd 5 mm/s)
links      they slide along themselves rather than sideways, the less so the faster the joints turn
all        without joint speed a snake does not move

Weighted least squares gives the step and its covariance. Slip is not white: its errors last for seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames
from snakesim_hal.wire.messages import Contact, Contacts, Description, Imu, JointState

ALONG_NORMAL_M_S = 0.005
SIDEWAYS_M_S = 0.02  # at rest,
SIDEWAYS_PER_RAD_S = 0.02  # and for each rad/s of the joints
ANY_M_S, ANY_PER_RAD_S = 0.005, 1.0
GYRO_RAD_S = 0.01
TURN_RAD_S = 1.0  # without a gyro
LASTING_S = 2.0
LONGEST_S = 0.2  # between two joint states; a step over a longer gap is only uncertain


@dataclass(frozen=True)
class Step:
    """Of the base, in its level frame before the step: forward, left, turn."""

    by: Floats  # (3,)
    covariance: Floats  # (3, 3) to add to that of the pose


class Odometry:
    """Steps from joint state to joint state."""

    def __init__(self, robot: Description) -> None:
        self._axes = [joint.axis for joint in robot.joints]
        self._lengths = [link.length_m for link in robot.links]
        self._half_m = 0.5 * np.array(self._lengths)
        self._before: tuple[int, Floats, Floats] | None = None  # stamp, origins, rotations in the level base frame

    def step(self, joints: JointState, tilt: Floats, contacts: Contacts | None, imu: Imu | None) -> Step | None:
        """The step since the last call; None for the first, and when no time has passed.

        tilt: (3, 3) level_from_base. contacts, imu: only when they are fresh.
        """
        origins, rotations = link_frames(np.zeros(3), tilt, joints.angle_rad, self._axes, self._lengths)
        before, self._before = self._before, (joints.timestamp_ns, origins, rotations)
        if before is None or joints.timestamp_ns <= before[0]:
            self._before = before or self._before
            return None
        period_s = (joints.timestamp_ns - before[0]) * 1e-9
        if period_s > LONGEST_S:
            return Step(np.zeros(3), np.diag([0.3 * period_s, 0.3 * period_s, period_s]) ** 2)
        turning = float(np.sqrt(np.mean(np.square(joints.velocity_rad_s))))
        rows, values, spreads = self._sliding(
            before[1] + self._half_m[:, None] * before[2][:, :, 0], origins, rotations
        )
        spreads = spreads * (SIDEWAYS_M_S + SIDEWAYS_PER_RAD_S * turning)
        if contacts is not None:
            add = self._touching(before, origins, rotations, contacts.contacts)
            rows, values, spreads = (np.concatenate(both) for both in zip((rows, values, spreads), add, strict=True))
        spreads = spreads * period_s
        rows = np.vstack([rows, np.eye(3)])
        turn_rad, turn_sd = self._turn(before[2], rotations, imu, period_s)
        still = (ANY_M_S + ANY_PER_RAD_S * turning) * period_s
        values = np.concatenate([values, [0.0, 0.0, turn_rad]])
        spreads = np.concatenate([spreads, [still, still, turn_sd]])
        information = rows.T @ (rows / np.square(spreads)[:, None])
        known = np.asarray(np.linalg.inv(information), dtype=np.float64)
        by: Floats = known @ (rows.T @ (values / np.square(spreads)))
        covariance: Floats = known * (LASTING_S / period_s)
        if imu is not None:  # whose noise is white
            covariance[2, :] = covariance[:, 2] = [0.0, 0.0, turn_sd**2]
        return Step(by, covariance)

    def _sliding(self, were: Floats, origins: Floats, rotations: Floats) -> tuple[Floats, ...]:
        """No link's middle moves sideways: rows (n, 3), values (n,), and shares of a speed's sd (n,)."""
        middles = origins + self._half_m[:, None] * rotations[:, :, 0]
        sideways = rotations[:, :2, 1]
        sideways = sideways / np.maximum(np.hypot(*sideways.T), 1e-6)[:, None]
        moved = (middles - were)[:, :2]  # by the joints alone
        return _rows(sideways, middles[:, :2]), -np.einsum("ij,ij->i", sideways, moved), np.ones(len(moved))

    def _touching(
        self, before: tuple[int, Floats, Floats], origins: Floats, rotations: Floats, contacts: Sequence[Contact]
    ) -> tuple[Floats, ...]:
        rows, values = [np.empty((0, 3))], []
        for contact in contacts:
            k = contact.link
            point, normal = np.array(contact.position_l), np.array(contact.normal_l)
            flat = (rotations[k] @ normal)[:2]
            length = float(np.hypot(*flat))
            if length < 0.5:
                continue  # lies on it
            flat = flat / length
            now = (origins[k] + rotations[k] @ point)[:2]
            then = (before[1][k] + before[2][k] @ point)[:2]
            rows.append(_rows(flat[None], now[None]))
            values.append(-float(flat @ (now - then)))
        return np.vstack(rows), np.array(values), np.full(len(values), ALONG_NORMAL_M_S)

    def _turn(self, was: Floats, rotations: Floats, imu: Imu | None, period_s: float) -> tuple[float, float]:
        """Turn of the base by the gyros, and its sd."""
        if imu is None or not imu.link:
            return 0.0, TURN_RAD_S * period_s
        turns: list[float] = []
        for link, rate in zip(imu.link, imu.angular_velocity_rad_s, strict=True):
            relative = rotations[link] @ was[link].T
            own = float(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))
            turns.append(float((rotations[link] @ np.array(rate))[2]) * period_s - own)
        return float(np.mean(turns)), GYRO_RAD_S * period_s


def _rows(direction: Floats, points: Floats) -> Floats:
    """How a step (x, y, turn) moves points (n, 2) along directions (n, 2)."""
    turning = direction[:, 1] * points[:, 0] - direction[:, 0] * points[:, 1]
    return np.column_stack([direction, turning])
