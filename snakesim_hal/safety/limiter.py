"""The limiter: the pure function between a command from the network and a motor. The same for every backend.

It checks, in this order: lease, freshness, layout and length, finite. A command that fails one is rejected whole. Then
every target is limited: angle, torque, distance to the measured angle, and rate. The rate limit of a joint that
changes mode starts from the present state of its motor, so no mode switch makes the torque jump.

Near its angle limit ("end") a joint is limited in every mode, which takes precedence over the rate limits:

position  the target is never beyond the end
velocity  never faster towards the end than the acceleration limit can stop before it, with four periods to spare for
          the latency to the motor and back; at the end or beyond it, only away from it
torque    no more towards the end than a motor would exert with that velocity target. So a joint that is too
          fast is braked; at the end or beyond it, no torque pushes outwards. A load that is stronger than the torque
          limit, or inertia that the torque limit cannot stop in time, may still drive a joint there.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.lease import Lease
from snakesim_hal.wire.freshness import oldest_state_ns
from snakesim_hal.wire.messages import Description, JointCommand, JointDescription, Mode

Ints = NDArray[np.int64]

REACTION_PERIODS = 4  # the minimum that keeps joints from overshooting their end, with two periods of latency on a bus


Refusal = Literal[
    "no_lease",
    "wrong_epoch",
    "replayed",
    "from_the_future",
    "stale",
    "wrong_layout",
    "wrong_length",
    "wrong_mode",
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
    max_step_rad: float
    period_s: float
    lease_ns: int
    oldest_state_ns: int  # an older joint state is rejected
    layout: str
    joints: tuple[JointDescription, ...]  # the same, joint by joint
    damps: NDArray[np.bool_]  # which joints have a velocity mode, (n_joints,)
    all_modes: bool  # whether every joint has every mode

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
            max_step_rad=description.max_step_rad,
            period_s=description.period_ns * 1e-9,
            lease_ns=description.lease_ns,
            oldest_state_ns=oldest_state_ns(description),
            layout=description.layout,
            joints=tuple(joints),
            damps=np.array([joint.has(Mode.VELOCITY) for joint in joints]),
            all_modes=all(joint.has(mode) for joint in joints for mode in Mode),
        )

    def inside(self, angle_rad: Floats) -> Floats:
        """Angles clamped to the angle limits, (n_joints,)."""
        return np.clip(angle_rad, self.angle_min_rad, self.angle_max_rad)


@dataclass(frozen=True)
class Measured:
    """Measured state of the joints, (n_joints,) each."""

    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats


@dataclass(frozen=True)
class Applied:
    """The last applied setpoints, (n_joints,) each."""

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
    """Why a command is rejected, or None. `age_ns` is how long ago the state it answers was published."""
    if not lease.live(now_ns):
        return "no_lease"
    if command.lease_epoch != lease.epoch:
        return "wrong_epoch"
    if command.sequence <= last_sequence:
        return "replayed"
    if command.tick > tick:
        return "from_the_future"
    if age_ns > min(command.valid_for_ns, limits.lease_ns):  # a sender may set less than a lease term, not more
        return "stale"
    if command.layout != limits.layout:
        return "wrong_layout"
    joints = len(limits.torque_nm)
    if len(command.mode) != joints or len(command.target) != joints:
        return "wrong_length"
    if command.torque_limit_nm is not None and len(command.torque_limit_nm) != joints:
        return "wrong_length"
    if not limits.all_modes and not all(map(JointDescription.has, limits.joints, command.mode)):
        return "wrong_mode"
    if not all(map(math.isfinite, command.target)):
        return "not_finite"
    if command.torque_limit_nm is not None and not all(map(math.isfinite, command.torque_limit_nm)):
        return "not_finite"
    return None


def limit(command: JointCommand, *, measured: Measured, last: Applied, limits: JointLimits, share: Floats) -> Applied:
    """Limit an accepted command.

    share: of its torque limit that is left to each joint after derating, (n_joints,), from 0 to 1.
    """
    asked_limits = limits.torque_nm.tolist() if command.torque_limit_nm is None else command.torque_limit_nm
    most = (limits.torque_nm * share).tolist()
    torque_limits: list[float] = []
    for asked, joint, cool, held in zip(asked_limits, limits.joints, most, last.torque_limit_nm.tolist(), strict=True):
        # It may fall at once, but rises no faster than the torque rate limit.
        rise = held + joint.torque_rate_limit_nm_s * limits.period_s
        torque_limits.append(_within(asked, 0.0, min(cool, rise)))
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
        same = mode == last_mode
        start = last_target if same else bumpless_target(joint, mode, angle, velocity, torque)
        if mode is Mode.POSITION:
            step, low, high = joint.speed_limit_rad_s, joint.angle_min_rad, joint.angle_max_rad
            # The measured angle moves by itself: its distance has precedence over the rate limit, the range over both.
            low, high = _within(angle - max_step_rad, low, high), _within(angle + max_step_rad, low, high)
        else:
            low, high = bounds_at_ends(joint, mode, angle, velocity, period_s)
            if mode is Mode.VELOCITY:
                step, most_of_it = joint.acceleration_limit_rad_s2, joint.speed_limit_rad_s
            else:
                step, most_of_it = joint.torque_rate_limit_nm_s, torque_limit
            low, high = _within(low, -most_of_it, most_of_it), _within(high, -most_of_it, most_of_it)
        step *= period_s
        targets.append(_within(_within(wanted, start - step, start + step), low, high))
    return Applied(np.array(command.mode, dtype=np.int64), np.array(targets), np.array(torque_limits))


def bounds_at_ends(
    joint: JointDescription, mode: Mode, angle_rad: float, velocity_rad_s: float, period_s: float
) -> tuple[float, float]:
    """Minimum and maximum velocity or torque that keep a joint between its angle limits."""
    back = stoppable_speed(angle_rad - joint.angle_min_rad, joint.acceleration_limit_rad_s2, period_s)
    ahead = stoppable_speed(joint.angle_max_rad - angle_rad, joint.acceleration_limit_rad_s2, period_s)
    if mode is Mode.VELOCITY:
        return -back, ahead
    # A low velocity gain would limit torque far from the end: so allow full torque to a motor at rest at full speed.
    gain = max(joint.velocity_gain_nm_s_per_rad, joint.torque_limit_nm / max(joint.speed_limit_rad_s, 1e-9))
    low, high = -gain * (back + velocity_rad_s), gain * (ahead - velocity_rad_s)
    if ahead == 0.0:
        high = min(high, 0.0)
    if back == 0.0:
        low = max(low, 0.0)
    return (min(low, high), high) if ahead == 0.0 else (low, max(low, high))


def stoppable_speed(distance_rad: float, acceleration_rad_s2: float, period_s: float) -> float:
    """The maximum speed from which a joint can stop within a distance, after some periods of reaction time.

    Solves speed * reaction time + speed^2 / (2 acceleration) = distance; 0 for a joint that is past it.
    """
    if distance_rad <= 0.0:
        return 0.0
    reaction_s = REACTION_PERIODS * period_s
    return acceleration_rad_s2 * (math.sqrt(reaction_s**2 + 2.0 * distance_rad / acceleration_rad_s2) - reaction_s)


def _within(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def bumpless_target(
    joint: JointDescription, mode: Mode, angle_rad: float, velocity_rad_s: float, torque_nm: float
) -> float:
    """The target with which a motor that changes to `mode` keeps its present torque."""
    if mode is Mode.POSITION:
        push_nm = torque_nm + joint.damping_nm_s_per_rad * velocity_rad_s
        return angle_rad + push_nm / max(joint.stiffness_nm_per_rad, 1e-9)
    if mode is Mode.VELOCITY:
        return velocity_rad_s + torque_nm / joint.velocity_gain_nm_s_per_rad
    return torque_nm if mode is Mode.TORQUE else 0.0


def why_limited(
    command: JointCommand, applied: Applied, *, measured: Measured, limits: JointLimits, share: Floats
) -> dict[int, str]:
    """For each limited joint: a short word to count by. Only called when there is one."""
    words: dict[int, str] = {}
    hot = bound_by_heat(command, limits, share)
    for i, (mode, want) in enumerate(zip(command.mode, command.target, strict=True)):
        if mode is Mode.PASSIVE:
            continue
        if applied.target[i] != want:
            angle, velocity = float(measured.angle_rad[i]), float(measured.velocity_rad_s[i])
            words[i] = _why(limits, i, mode, want, angle, velocity, float(applied.torque_limit_nm[i]))
        if hot[i] and words.get(i, "torque") == "torque":
            words[i] = "thermal"
    return words


def bound_by_heat(command: JointCommand, limits: JointLimits, share: Floats) -> NDArray[np.bool_]:
    """Which joints get a lower torque limit than commanded because they are hot, (n_joints,)."""
    asked = (
        limits.torque_nm if command.torque_limit_nm is None else np.minimum(command.torque_limit_nm, limits.torque_nm)
    )
    return asked > limits.torque_nm * share


def _why(
    limits: JointLimits, i: int, mode: Mode, want: float, angle: float, velocity: float, torque_limit: float
) -> str:
    joint = limits.joints[i]
    if mode is Mode.POSITION:
        return "angle_rate" if joint.angle_min_rad <= want <= joint.angle_max_rad else "angle"
    low, high = bounds_at_ends(joint, mode, angle, velocity, limits.period_s)
    fast = mode is Mode.VELOCITY
    most = joint.speed_limit_rad_s if fast else torque_limit
    if (want > high and high < most) or (want < low and low > -most):
        return "angle"
    if abs(want) > most:
        return "speed" if fast else "torque"
    return "acceleration" if fast else "torque_rate"


def as_setpoints(applied: Applied, isolated: frozenset[int]) -> SafeSetpoints:
    """For the backend. isolated: indices of isolated joints."""
    modes = [_MODES[code] for code in applied.mode.tolist()]
    return SafeSetpoints(modes, applied.target.tolist(), applied.torque_limit_nm.tolist(), isolated)


_MODES = {int(mode): mode for mode in Mode}
