"""The measurements of a run of the joint check: what encoders, motors, IMUs and motion capture said, tick by tick."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Drive
from snakesim_hal.model.kinematics import rotation_from_quaternion
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Description, Imu
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.record import RunRecord

COLUMNS = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "orientation_wxyz")
NO_MOTION_RAD = 1e-6  # by which a target differs from its rest while its joint is moved
CLAMPED = 0.9  # of the largest step from the measured angle: such a target is the command limiter's
PITCH, YAW = 1, 2  # components of a vector in a link's frame
Select = NDArray[np.bool_]


@dataclass(frozen=True)
class Measured:
    """A run of the joint check; rows are ticks."""

    period_s: float
    names: Sequence[str]
    axes: Sequence[str]  # "yaw" or "pitch"
    drives: Sequence[Drive]  # as the robot file says
    angle_rad: Floats  # (n, joints)
    velocity_rad_s: Floats  # (n, joints)
    torque_nm: Floats  # (n, joints)
    target_rad: Floats  # (n, joints)
    link_rate_rad_s: Floats  # (n, links, 3), in the link's frame; NaN where no IMU reported
    link_force_m_s2: Floats  # (n, links, 3): specific force, in the link's frame; at rest 1 g upwards
    base_turn_rad: Floats  # (n, 3): integral of link 0's rate, in its frame; NaN without motion capture

    def moved_by_target(self, joint: int) -> Select:
        """Return the ticks in which the joint's target is away from its rest, (n,)."""
        target_rad = self.target_rad[:, joint]
        return np.abs(target_rad - np.median(target_rad)) > NO_MOTION_RAD

    def at_rest(self) -> Select:
        """Return the ticks in which no joint's target is away from its rest, (n,)."""
        moved = [self.moved_by_target(joint) for joint in range(len(self.names))]
        return ~np.logical_or.reduce(moved)

    def before_motion(self) -> Select:
        """Return the ticks before the first joint is moved, (n,)."""
        return np.logical_and.accumulate(self.at_rest())

    def moved_rad(self, joint: int) -> float:
        """Return how far the joint moved by its encoder, from end to end."""
        moved = self.moved_by_target(joint)
        return float(np.ptp(self.angle_rad[moved, joint])) if moved.any() else 0.0

    def component(self, joint: int) -> int:
        """Return which component of a vector in a link's frame is about the joint's axis."""
        return YAW if self.axes[joint] == "yaw" else PITCH


def imus_of(record: RunRecord) -> Iterable[Imu]:
    """Read every IMU message of a run. Raises ConfigError."""
    path = record.folder if record.alone else record.folder / RECORDING
    decoder = Decoder(Imu)
    for message in RecordingReader(path).messages([keys.IMU]):
        yield decoder.decode(message.payload, message.encoding)


def ticks_of(record: RunRecord) -> list[int]:
    """Return the tick of every row."""
    return np.round(record.time_s * record.config.rate_hz).astype(int).tolist()


def by_imus(imus: Iterable[Imu], ticks: Sequence[int], links: int) -> tuple[Floats, Floats]:
    """Return angular rates and specific forces of the links, both (n, links, 3); NaN where no IMU reported."""
    row_of_tick = {tick: row for row, tick in enumerate(ticks)}
    rates = np.full((len(ticks), links, 3), np.nan)
    forces = np.full((len(ticks), links, 3), np.nan)
    for imu in imus:
        row = row_of_tick.get(imu.tick)
        if row is not None:
            rates[row, imu.link] = imu.angular_velocity_rad_s
            forces[row, imu.link] = imu.acceleration_m_s2
    return rates, forces


def measured(
    config: RunConfig, robot: Description, ticks: Sequence[int], columns: Mapping[str, Floats], imus: Iterable[Imu]
) -> Measured:
    """Return what joints, IMUs and motion capture measured. columns: those of `COLUMNS`, one row a tick."""
    rates, forces = by_imus(imus, ticks, len(robot.links))
    sensor = config.robot.sensors.pose
    late = 0 if sensor is None else round(sensor.delay_s * config.rate_hz)
    poses = np.full_like(columns["orientation_wxyz"], np.nan)
    poses[: len(poses) - late] = columns["orientation_wxyz"][late:]
    target_rad = unclamped(columns["target"], columns["angle_rad"], config.robot.safety.max_step_rad)
    return Measured(
        period_s=config.period_ns * 1e-9,
        names=[joint.name for joint in robot.joints],
        axes=[joint.axis for joint in robot.joints],
        drives=[joint.drive for joint in config.robot.joint_table],
        angle_rad=columns["angle_rad"],
        velocity_rad_s=columns["velocity_rad_s"],
        torque_nm=columns["torque_nm"],
        target_rad=target_rad,
        link_rate_rad_s=rates,
        link_force_m_s2=forces,
        base_turn_rad=_turns(poses),
    )


def unclamped(target_rad: Floats, angle_rad: Floats, max_step_rad: float) -> Floats:
    """Return the targets of the check, (n, joints), without those to which the command limiter brought them.

    A joint without current is swung by the motion of others. Once it is `max_step_rad` from its target, the limiter
    moves the target along with it, which is no motion of the check.
    """
    clamped = np.abs(target_rad - angle_rad) > CLAMPED * max_step_rad
    at_rest_rad = np.nanmedian(np.where(clamped, np.nan, target_rad), axis=0)
    return np.where(clamped, at_rest_rad, target_rad)


def _turns(wxyz: Floats) -> Floats:
    """Return the integral of the base's angular rate in its own frame from the first known orientation, (n, 3).

    That is what a gyro on the base would measure. A rotation from the first orientation would not be about the axis of
    a joint any more once the body has rolled, as a straight body on a flat floor does.
    """
    turns = np.full((len(wxyz), 3), np.nan)
    known = np.flatnonzero(np.isfinite(wxyz).all(axis=1) & (np.abs(wxyz).sum(axis=1) > 0))
    if not len(known):
        return turns
    turned = np.zeros(3)
    before = rotation_from_quaternion(wxyz[known[0]])
    for row in known:
        now = rotation_from_quaternion(wxyz[row])
        step = before.T @ now  # small: of one tick, or of a few
        turned = turned + np.array((step[2, 1] - step[1, 2], step[0, 2] - step[2, 0], step[1, 0] - step[0, 1])) / 2
        turns[row] = turned
        before = now
    return turns
