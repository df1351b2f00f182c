"""The gate: the one pure function between a command from the network and a motor. The same for every backend.

In this order: lease, freshness, layout and length, finite. What fails there is refused whole. Then every target is
brought inside its limits: angle, torque, distance to the measured angle, and rate. The rate limit of a joint that
changes mode starts from what its motor is doing at that instant, so no mode switch makes the torque jump.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.backend import SetPoints
from snakesim_hal.lease import Lease
from snakesim_hal.messages import Description, JointCommand, JointDescription, Mode

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
    torque_nm: Floats
    max_step_rad: float
    period_s: float
    lease_ns: int
    layout: str
    joints: tuple[JointDescription, ...]  # the same, joint by joint

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
            torque_nm=column("torque_limit_nm"),
            max_step_rad=description.max_step_rad,
            period_s=description.period_ns * 1e-9,
            lease_ns=description.lease_ns,
            layout=description.layout,
            joints=tuple(joints),
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
    if age_ns > min(command.valid_for_ns, limits.lease_ns):  # a sender may ask for less than a lease term, not more
        return "stale"
    if command.layout != limits.layout:
        return "wrong_layout"
    joints = len(limits.torque_nm)
    if len(command.mode) != joints or len(command.target) != joints:
        return "wrong_length"
    if command.torque_limit_nm is not None and len(command.torque_limit_nm) != joints:
        return "wrong_length"
    if not all(map(math.isfinite, command.target)):
        return "not_finite"
    if command.torque_limit_nm is not None and not all(map(math.isfinite, command.torque_limit_nm)):
        return "not_finite"
    return None


def limit(command: JointCommand, *, measured: Measured, last: Applied, limits: JointLimits) -> tuple[Applied, Floats]:
    """Bring an accepted command inside every limit. Returns what is applied, and what was asked for (n_joints,)."""
    asked_limits = limits.torque_nm.tolist() if command.torque_limit_nm is None else command.torque_limit_nm
    torque_limits: list[float] = []
    for asked, joint, held in zip(asked_limits, limits.joints, last.torque_limit_nm.tolist(), strict=True):
        # It may fall at once, but rises no faster than a torque may.
        rise = held + joint.torque_rate_limit_nm_s * limits.period_s
        torque_limits.append(_within(asked, 0.0, min(joint.torque_limit_nm, rise)))
    before = zip(last.mode.tolist(), last.target.tolist(), strict=True)
    now = zip(measured.angle_rad.tolist(), measured.velocity_rad_s.tolist(), measured.torque_nm.tolist(), strict=True)
    period_s, max_step_rad = limits.period_s, limits.max_step_rad
    targets: list[float] = []
    # Plain numbers, joint by joint: for a dozen joints that is several times faster than vectors.
    for joint, mode, wanted, torque_limit, (last_mode, last_target), (angle, velocity, torque) in zip(
        limits.joints, command.mode, command.target, torque_limits, before, now, strict=True
    ):
        if mode is Mode.PASSIVE:
            targets.append(0.0)
            continue
        same = mode.value == last_mode
        start = last_target if same else bumpless_target(joint, mode, angle, velocity, torque)
        if mode is Mode.POSITION:
            step, low, high = joint.speed_limit_rad_s, joint.angle_min_rad, joint.angle_max_rad
            # The measured angle moves on its own: staying near it outranks the rate limit, and being in range both.
            low, high = _within(angle - max_step_rad, low, high), _within(angle + max_step_rad, low, high)
        elif mode is Mode.VELOCITY:
            step, high = joint.acceleration_limit_rad_s2, joint.speed_limit_rad_s
            low = -high
        else:
            step, high = joint.torque_rate_limit_nm_s, torque_limit
            low = -high
        step *= period_s
        targets.append(_within(_within(wanted, start - step, start + step), low, high))
    applied = Applied(np.array(command.mode, dtype=np.int64), np.array(targets), np.array(torque_limits))
    return applied, np.array(command.target, dtype=np.float64)


def _within(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def bumpless_target(
    joint: JointDescription, mode: Mode, angle_rad: float, velocity_rad_s: float, torque_nm: float
) -> float:
    """The target with which a motor that changes to `mode` goes on with the torque it has now."""
    if mode is Mode.POSITION:
        push_nm = torque_nm + joint.damping_nm_s_per_rad * velocity_rad_s
        return angle_rad + push_nm / max(joint.stiffness_nm_per_rad, 1e-9)
    if mode is Mode.VELOCITY:
        return velocity_rad_s + torque_nm / joint.velocity_gain_nm_s_per_rad
    return torque_nm if mode is Mode.TORQUE else 0.0


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
