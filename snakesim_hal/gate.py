"""The gate: the one pure function between a command from the network and a motor. The same for every backend.

In this order: lease, freshness, layout and length, finite. What fails there is refused whole. Then every target is
brought inside its limits: angle, torque, distance to the measured angle, and rate. The rate limit of a joint that
changes mode starts from what its motor is doing at that instant, so no mode switch makes the torque jump.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.backend import SetPoints
from snakesim_hal.lease import Lease
from snakesim_hal.messages import Description, JointCommand, Mode

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Refusal = Literal[
    "no_lease",
    "wrong_epoch",
    "replayed",
    "from_the_future",
    "stale",
    "wrong_layout",
    "wrong_length",
    "not_finite",
]


@dataclass(frozen=True)
class JointLimits:
    """The robot's limits as vectors, (n_joints,) each."""

    angle_min_rad: Floats
    angle_max_rad: Floats
    speed_rad_s: Floats
    acceleration_rad_s2: Floats
    torque_nm: Floats
    torque_rate_nm_s: Floats
    stiffness_nm_per_rad: Floats
    damping_nm_s_per_rad: Floats
    max_step_rad: float
    period_s: float
    layout: str

    @staticmethod
    def of(description: Description) -> "JointLimits":
        """The limits that a description states."""
        joints = description.joints

        def column(name: str) -> Floats:
            return np.array([getattr(joint, name) for joint in joints], dtype=np.float64)

        return JointLimits(
            angle_min_rad=column("angle_min_rad"),
            angle_max_rad=column("angle_max_rad"),
            speed_rad_s=column("speed_limit_rad_s"),
            acceleration_rad_s2=column("acceleration_limit_rad_s2"),
            torque_nm=column("torque_limit_nm"),
            torque_rate_nm_s=column("torque_rate_limit_nm_s"),
            stiffness_nm_per_rad=column("stiffness_nm_per_rad"),
            damping_nm_s_per_rad=column("damping_nm_s_per_rad"),
            max_step_rad=description.max_step_rad,
            period_s=description.period_ns * 1e-9,
            layout=description.layout,
        )


@dataclass(frozen=True)
class Measured:
    """What the joints are doing now, (n_joints,) each."""

    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats


@dataclass(frozen=True)
class Applied:
    """What the motors were last told, (n_joints,) each."""

    mode: Ints
    target: Floats
    torque_limit_nm: Floats


def refuse(
    command: JointCommand,
    *,
    lease: Lease,
    now_ns: int,
    tick: int,
    last_sequence: int,
    age_ns: int,
    limits: JointLimits,
) -> Refusal | None:
    """Why a command may not be used at all, or None. `age_ns` is how long ago the state it answers was published."""
    if not lease.live(now_ns):
        return "no_lease"
    if command.lease_epoch != lease.epoch:
        return "wrong_epoch"
    if command.sequence <= last_sequence:
        return "replayed"
    if command.tick > tick:
        return "from_the_future"
    if age_ns > command.valid_for_ns:
        return "stale"
    if command.layout != limits.layout:
        return "wrong_layout"
    joints = len(limits.torque_nm)
    if len(command.mode) != joints or len(command.target) != joints:
        return "wrong_length"
    if command.torque_limit_nm is not None and len(command.torque_limit_nm) != joints:
        return "wrong_length"
    if not np.isfinite(np.asarray(command.target)).all():
        return "not_finite"
    if command.torque_limit_nm is not None and not np.isfinite(np.asarray(command.torque_limit_nm)).all():
        return "not_finite"
    return None


def limit(command: JointCommand, *, measured: Measured, last: Applied, limits: JointLimits) -> tuple[Applied, Floats]:
    """Bring an accepted command inside every limit. Returns what is applied, and what was asked for (n_joints,)."""
    mode = np.array(command.mode, dtype=np.int64)
    asked = np.array(command.target, dtype=np.float64)
    if command.torque_limit_nm is None:
        torque_limit = limits.torque_nm
    else:
        torque_limit = np.clip(np.array(command.torque_limit_nm, dtype=np.float64), 0.0, limits.torque_nm)
    low, high = _bounds(mode, torque_limit, measured, last, limits)
    target = np.minimum(np.maximum(asked, low), high)
    target[mode == Mode.PASSIVE] = 0.0
    return Applied(mode, target, torque_limit), asked


def _bounds(
    mode: Ints, torque_limit: Floats, measured: Measured, last: Applied, limits: JointLimits
) -> tuple[Floats, Floats]:
    """Lowest and highest target that each joint may be given now, in its mode's unit."""
    low = np.zeros(len(mode))
    high = np.zeros(len(mode))
    start = np.where(mode == last.mode, last.target, bumpless_target(mode, measured, limits))
    angle, speed, torque = mode == Mode.POSITION, mode == Mode.VELOCITY, mode == Mode.TORQUE
    if angle.any():
        step = limits.speed_rad_s * limits.period_s
        near_low = np.maximum(measured.angle_rad - limits.max_step_rad, limits.angle_min_rad)
        near_high = np.minimum(measured.angle_rad + limits.max_step_rad, limits.angle_max_rad)
        near_low = np.minimum(near_low, limits.angle_max_rad)
        near_high = np.maximum(near_high, limits.angle_min_rad)
        # The measured angle moves on its own: staying near it outranks the rate limit.
        low[angle] = np.clip(start - step, near_low, near_high)[angle]
        high[angle] = np.clip(start + step, near_low, near_high)[angle]
    if speed.any():
        step = limits.acceleration_rad_s2 * limits.period_s
        low[speed] = np.clip(start - step, -limits.speed_rad_s, limits.speed_rad_s)[speed]
        high[speed] = np.clip(start + step, -limits.speed_rad_s, limits.speed_rad_s)[speed]
    if torque.any():
        step = limits.torque_rate_nm_s * limits.period_s
        low[torque] = np.clip(start - step, -torque_limit, torque_limit)[torque]
        high[torque] = np.clip(start + step, -torque_limit, torque_limit)[torque]
    return low, high


def bumpless_target(mode: Ints, measured: Measured, limits: JointLimits) -> Floats:
    """The target with which a motor that changes to `mode` goes on with the torque it has now, (n_joints,)."""
    push = measured.torque_nm + limits.damping_nm_s_per_rad * measured.velocity_rad_s
    hold = measured.angle_rad + push / np.maximum(limits.stiffness_nm_per_rad, 1e-9)
    target = np.where(mode == Mode.POSITION, hold, 0.0)
    target = np.where(mode == Mode.VELOCITY, measured.velocity_rad_s, target)
    return np.where(mode == Mode.TORQUE, measured.torque_nm, target)


def why_limited(applied: Applied, asked: Floats, limits: JointLimits) -> dict[int, str]:
    """For each joint whose target was changed: a short word to count by. Only called when something was changed."""
    words: dict[int, str] = {}
    for i in np.flatnonzero((applied.target != asked) & (applied.mode != Mode.PASSIVE)):
        mode, want = applied.mode[i], asked[i]
        if mode == Mode.POSITION:
            outside = not limits.angle_min_rad[i] <= want <= limits.angle_max_rad[i]
            words[int(i)] = "angle" if outside else "angle_rate"
        elif mode == Mode.VELOCITY:
            words[int(i)] = "speed" if abs(want) > limits.speed_rad_s[i] else "acceleration"
        else:
            words[int(i)] = "torque" if abs(want) > applied.torque_limit_nm[i] else "torque_rate"
    return words


def as_set_points(applied: Applied) -> SetPoints:
    """For the backend."""
    modes = [_MODES[code] for code in applied.mode.tolist()]
    return SetPoints(modes, applied.target.tolist(), applied.torque_limit_nm.tolist())


_MODES = {int(mode): mode for mode in Mode}
