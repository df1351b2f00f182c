"""The limiter: the pure function between a command from the network and a motor. The same for every backend.

`find_rejection_reason` rejects a command as a whole. It checks, in this order: lease, freshness, layout and length,
modes, and that every number is finite.

`limit_command` then limits every target of an accepted command: angle, torque, distance to the measured angle, and
rate. The rate limit of a joint that changes mode starts from the present state of its motor, so no mode switch makes
the torque jump.

Near its angle limit ("end") a joint is limited in every mode, which takes precedence over the rate limits:

position  the target is never beyond the end
velocity  never faster towards the end than the acceleration limit can stop before it, with four periods to spare for
          the latency to the motor and back; at the end or beyond it, only away from it
torque    no more towards the end than a motor would exert with that velocity target. So a joint that is too
          fast is braked; at the end or beyond it, no torque pushes outwards. A load that is stronger than the torque
          limit, or inertia that the torque limit cannot stop in time, may still drive a joint there.
"""

import math
from typing import Literal

import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, MeasuredState
from snakesim_hal.safety.lease import CommandLease
from snakesim_hal.wire.messages import JointCommand, JointDescription, JointMode

REACTION_PERIODS = 4  # the minimum that keeps joints from overshooting their end, with two periods of latency on a bus
MIN_SPEED_LIMIT_RAD_S = 1e-9  # divisor for a joint that may not move
MIN_STIFFNESS_NM_PER_RAD = 1e-9  # divisor for a joint without stiffness

RejectionReason = Literal[
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
_MODES = {int(mode): mode for mode in JointMode}


# --- checks of a whole command ---------------------------------------------------------------------------------


def find_rejection_reason(
    command: JointCommand,
    *,
    lease: CommandLease,
    now_ns: int,
    tick: int,
    last_sequence: int,
    age_ns: int,
    limits: JointLimits,
) -> RejectionReason | None:
    """Return the first reason to reject a command as a whole, or None if it may be applied.

    Args:
        command: Command as it was received.
        lease: Current lease.
        now_ns: Safety time in ns.
        tick: Newest tick that the host has published.
        last_sequence: Sequence number of the last accepted command; -1 if there is none.
        age_ns: Time in ns since the joint state that the command answers was published.
        limits: Limits of the robot.
    """
    if not lease.is_held(now_ns):
        return "no_lease"
    if command.lease_epoch != lease.epoch:
        return "wrong_epoch"
    if command.sequence <= last_sequence:
        return "replayed"
    if command.tick > tick:
        return "from_the_future"
    if age_ns > min(
        command.valid_for_ns, limits.lease_ns
    ):  # a sender may set less than a lease term, not more
        return "stale"
    if command.layout != limits.layout:
        return "wrong_layout"
    joint_count = len(limits.torque_nm)
    if len(command.mode) != joint_count or len(command.target) != joint_count:
        return "wrong_length"
    if command.torque_limit_nm is not None and len(command.torque_limit_nm) != joint_count:
        return "wrong_length"
    if not limits.has_all_modes and not all(
        map(JointDescription.supports_mode, limits.joints, command.mode)
    ):
        return "wrong_mode"
    if not all(map(math.isfinite, command.target)):
        return "not_finite"
    if command.torque_limit_nm is not None and not all(map(math.isfinite, command.torque_limit_nm)):
        return "not_finite"
    return None


# --- limits of an accepted command -----------------------------------------------------------------------------


def limit_command(
    command: JointCommand,
    *,
    measured: MeasuredState,
    last: AppliedSetpoints,
    limits: JointLimits,
    torque_fraction: Floats,
) -> AppliedSetpoints:
    """Limit the torque limits and the targets of an accepted command.

    The loop runs on plain floats: for a dozen joints that is several times faster than vectors.

    Args:
        command: Command that `find_rejection_reason` has accepted.
        measured: Last plausible state of the joints.
        last: Setpoints of the previous period.
        limits: Limits of the robot.
        torque_fraction: (n_joints,) fraction of each torque limit that derating leaves, from 0 to 1.
    """
    torque_limits = _limit_torque_limits(command, last, limits, torque_fraction)
    targets: list[float] = []
    for (
        joint,
        mode,
        requested,
        torque_limit,
        last_mode,
        last_target,
        angle,
        velocity,
        torque,
    ) in zip(
        limits.joints,
        command.mode,
        command.target,
        torque_limits,
        last.mode.tolist(),
        last.target.tolist(),
        measured.angle_rad.tolist(),
        measured.velocity_rad_s.tolist(),
        measured.torque_nm.tolist(),
        strict=True,
    ):
        start = last_target
        if mode != last_mode:
            start = compute_bumpless_target(joint, mode, angle, velocity, torque)
        match mode:
            case JointMode.POSITION:
                target = _limit_angle_target(joint, requested, start, angle, limits)
            case JointMode.VELOCITY:
                target = _limit_velocity_target(joint, requested, start, angle, limits.period_s)
            case JointMode.TORQUE:
                target = _limit_torque_target(
                    joint, requested, start, torque_limit, angle, velocity, limits.period_s
                )
            case _:  # passive
                target = 0.0
        targets.append(target)
    return AppliedSetpoints(
        np.array(command.mode, dtype=np.int64), np.array(targets), np.array(torque_limits)
    )


def _limit_torque_limits(
    command: JointCommand, last: AppliedSetpoints, limits: JointLimits, torque_fraction: Floats
) -> list[float]:
    """Return each joint's torque limit in N·m: as requested, but at most what derating and the rate limit allow.

    A torque limit may fall at once, but rises no faster than the torque rate limit.

    Args:
        command: Accepted command. Without torque limits of its own, it requests those of the robot.
        last: Setpoints of the previous period.
        limits: Limits of the robot.
        torque_fraction: (n_joints,) fraction of each torque limit that derating leaves, from 0 to 1.
    """
    requested_limits = command.torque_limit_nm
    if requested_limits is None:
        requested_limits = limits.torque_nm.tolist()
    derated_limits = (limits.torque_nm * torque_fraction).tolist()
    last_limits = last.torque_limit_nm.tolist()
    period_s = limits.period_s
    torque_limits: list[float] = []
    for joint, requested, derated, last_limit in zip(
        limits.joints, requested_limits, derated_limits, last_limits, strict=True
    ):
        rate_limited = last_limit + joint.torque_rate_limit_nm_s * period_s
        torque_limits.append(_clamp(requested, 0.0, min(derated, rate_limited)))
    return torque_limits


def _limit_angle_target(
    joint: JointDescription,
    requested_rad: float,
    start_rad: float,
    angle_rad: float,
    limits: JointLimits,
) -> float:
    """Return the angle target in rad that is nearest to the requested one within all limits.

    The measured angle moves by itself. So the distance to it takes precedence over the rate limit, and the angle
    limits take precedence over both.
    """
    angle_min = joint.angle_min_rad
    angle_max = joint.angle_max_rad
    low = _clamp(angle_rad - limits.max_step_rad, angle_min, angle_max)
    high = _clamp(angle_rad + limits.max_step_rad, angle_min, angle_max)
    step = joint.speed_limit_rad_s * limits.period_s
    return _clamp(_clamp(requested_rad, start_rad - step, start_rad + step), low, high)


def _limit_velocity_target(
    joint: JointDescription,
    requested_rad_s: float,
    start_rad_s: float,
    angle_rad: float,
    period_s: float,
) -> float:
    """Return the velocity target in rad/s that is nearest to the requested one within all limits."""
    max_speed = joint.speed_limit_rad_s
    low, high = compute_velocity_bounds(joint, angle_rad, period_s)
    low = _clamp(low, -max_speed, max_speed)
    high = _clamp(high, -max_speed, max_speed)
    step = joint.acceleration_limit_rad_s2 * period_s
    return _clamp(_clamp(requested_rad_s, start_rad_s - step, start_rad_s + step), low, high)


def _limit_torque_target(
    joint: JointDescription,
    requested_nm: float,
    start_nm: float,
    torque_limit_nm: float,
    angle_rad: float,
    velocity_rad_s: float,
    period_s: float,
) -> float:
    """Return the torque target in N·m that is nearest to the requested one within all limits."""
    low, high = compute_torque_bounds(joint, angle_rad, velocity_rad_s, period_s)
    low = _clamp(low, -torque_limit_nm, torque_limit_nm)
    high = _clamp(high, -torque_limit_nm, torque_limit_nm)
    step = joint.torque_rate_limit_nm_s * period_s
    return _clamp(_clamp(requested_nm, start_nm - step, start_nm + step), low, high)


def _clamp(value: float, low: float, high: float) -> float:
    if value < low:
        return low
    if value > high:
        return high
    return value


# --- ends of a joint -------------------------------------------------------------------------------------------


def compute_velocity_bounds(
    joint: JointDescription, angle_rad: float, period_s: float
) -> tuple[float, float]:
    """Return the minimum and maximum velocity in rad/s from which a joint can stop before its ends."""
    speed_to_lower_end = compute_stoppable_speed(
        angle_rad - joint.angle_min_rad, joint.acceleration_limit_rad_s2, period_s
    )
    speed_to_upper_end = compute_stoppable_speed(
        joint.angle_max_rad - angle_rad, joint.acceleration_limit_rad_s2, period_s
    )
    return -speed_to_lower_end, speed_to_upper_end


def compute_torque_bounds(
    joint: JointDescription, angle_rad: float, velocity_rad_s: float, period_s: float
) -> tuple[float, float]:
    """Return the minimum and maximum torque in N·m that keep a joint between its ends.

    With the velocity bounds v_min <= v <= v_max and a velocity gain k, the torque bounds are k (v_min - v) and
    k (v_max - v): what a motor in velocity mode would exert with these bounds as its target.
    """
    speed_to_lower_end = compute_stoppable_speed(
        angle_rad - joint.angle_min_rad, joint.acceleration_limit_rad_s2, period_s
    )
    speed_to_upper_end = compute_stoppable_speed(
        joint.angle_max_rad - angle_rad, joint.acceleration_limit_rad_s2, period_s
    )
    # A low velocity gain would limit the torque far from the ends. So the gain is at least the one that gives full
    # torque for a speed error of the whole speed limit.
    max_speed = max(joint.speed_limit_rad_s, MIN_SPEED_LIMIT_RAD_S)
    gain = max(joint.velocity_gain_nm_s_per_rad, joint.torque_limit_nm / max_speed)
    low = -gain * (speed_to_lower_end + velocity_rad_s)
    high = gain * (speed_to_upper_end - velocity_rad_s)
    if speed_to_lower_end == 0.0:
        low = max(low, 0.0)
    if speed_to_upper_end == 0.0:
        high = min(high, 0.0)
        return min(low, high), high
    return low, max(low, high)


def compute_stoppable_speed(
    distance_rad: float, acceleration_rad_s2: float, period_s: float
) -> float:
    """Return the maximum speed in rad/s from which a joint can stop within a distance d.

    The joint continues at its speed v for a reaction time t of REACTION_PERIODS, and then brakes with its acceleration
    limit a. Solves v t + v^2 / (2 a) = d, so v = a (sqrt(t^2 + 2 d / a) - t). For a joint that is past its end
    (d <= 0) the speed is 0.
    """
    if distance_rad <= 0.0:
        return 0.0
    reaction_s = REACTION_PERIODS * period_s
    return acceleration_rad_s2 * (
        math.sqrt(reaction_s**2 + 2.0 * distance_rad / acceleration_rad_s2) - reaction_s
    )


def compute_bumpless_target(
    joint: JointDescription,
    mode: JointMode,
    angle_rad: float,
    velocity_rad_s: float,
    torque_nm: float,
) -> float:
    """Return the target with which a motor that changes to another mode keeps its current torque.

    A motor in position mode exerts kp (target - angle) - kd velocity, and one in velocity mode kv (target - velocity).
    Both equations are solved for the target.

    Args:
        joint: Joint with the gains of its motor.
        mode: Mode that the motor changes to.
        angle_rad: Measured angle.
        velocity_rad_s: Measured velocity.
        torque_nm: Measured torque.

    Returns:
        The target in rad, rad/s or N·m, depending on the mode.
    """
    match mode:
        case JointMode.POSITION:
            spring_torque_nm = torque_nm + joint.damping_nm_s_per_rad * velocity_rad_s
            return angle_rad + spring_torque_nm / max(
                joint.stiffness_nm_per_rad, MIN_STIFFNESS_NM_PER_RAD
            )
        case JointMode.VELOCITY:
            return velocity_rad_s + torque_nm / joint.velocity_gain_nm_s_per_rad
        case JointMode.TORQUE:
            return torque_nm
        case JointMode.PASSIVE:
            return 0.0


# --- output ----------------------------------------------------------------------------------------------------


def make_safe_setpoints(applied: AppliedSetpoints, isolated: frozenset[int]) -> SafeSetpoints:
    """Return limited setpoints in the form that a backend gets.

    Args:
        applied: Limited setpoints.
        isolated: Indices of isolated joints.
    """
    modes = [_MODES[code] for code in applied.mode.tolist()]
    return SafeSetpoints(modes, applied.target.tolist(), applied.torque_limit_nm.tolist(), isolated)
