"""Names of the limits that changed a command, for counters and for people. Pure; nothing here moves a motor."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, JointMask, MeasuredState
from snakesim_hal.safety.limiter import compute_torque_bounds, compute_velocity_bounds
from snakesim_hal.wire.messages import JointCommand, JointDescription, JointMode


def find_active_limits(
    command: JointCommand,
    applied: AppliedSetpoints,
    *,
    measured: MeasuredState,
    limits: JointLimits,
    torque_fraction: Floats,
) -> dict[int, str]:
    """Return a short name of the limit that changed the command of each limited joint, by joint index.

    Call this function only if `limit_command` has changed a target, or if a joint is derated.

    Args:
        command: Command before the limiter.
        applied: Setpoints after the limiter.
        measured: Joint state that the limiter used.
        limits: Limits of the robot.
        torque_fraction: (n_joints,) fraction of each torque limit that derating leaves, from 0 to 1.

    Returns:
        One of "angle", "angle_rate", "speed", "acceleration", "torque", "torque_rate" and "thermal" for each limited
        joint.
    """
    names: dict[int, str] = {}
    derated = find_derated_joints(command, limits, torque_fraction)
    for i, (mode, requested) in enumerate(zip(command.mode, command.target, strict=True)):
        if mode is JointMode.PASSIVE:
            continue
        if applied.target[i] != requested:
            angle = float(measured.angle_rad[i])
            velocity = float(measured.velocity_rad_s[i])
            torque_limit = float(applied.torque_limit_nm[i])
            names[i] = _find_tightest_limit(
                limits.joints[i], mode, requested, angle, velocity, torque_limit, limits.period_s
            )
        if derated[i] and names.get(i, "torque") == "torque":
            names[i] = "thermal"
    return names


def find_derated_joints(
    command: JointCommand, limits: JointLimits, torque_fraction: Floats
) -> JointMask:
    """Return a mask of the joints that get a lower torque limit than commanded because they are hot, (n_joints,)."""
    requested_nm = limits.torque_nm
    if command.torque_limit_nm is not None:
        requested_nm = np.minimum(command.torque_limit_nm, limits.torque_nm)
    return requested_nm > limits.torque_nm * torque_fraction


def _find_tightest_limit(
    joint: JointDescription,
    mode: JointMode,
    requested: float,
    angle_rad: float,
    velocity_rad_s: float,
    torque_limit_nm: float,
    period_s: float,
) -> str:
    """Return the name of the tightest limit that a requested target exceeds.

    Args:
        joint: Joint with its limits.
        mode: Mode of the target, any but passive.
        requested: Requested target in rad, rad/s or N·m, depending on the mode.
        angle_rad: Measured angle.
        velocity_rad_s: Measured velocity.
        torque_limit_nm: Torque limit of this period.
        period_s: Duration of a control period.
    """
    match mode:
        case JointMode.VELOCITY:
            bounds = compute_velocity_bounds(joint, angle_rad, period_s)
            magnitude_limit = joint.speed_limit_rad_s
            magnitude_name = "speed"
            rate_name = "acceleration"
        case JointMode.TORQUE:
            bounds = compute_torque_bounds(joint, angle_rad, velocity_rad_s, period_s)
            magnitude_limit = torque_limit_nm
            magnitude_name = "torque"
            rate_name = "torque_rate"
        case _:
            if joint.angle_min_rad <= requested <= joint.angle_max_rad:
                return "angle_rate"
            return "angle"
    low, high = bounds
    above_end_bound = requested > high and high < magnitude_limit
    below_end_bound = requested < low and low > -magnitude_limit
    if above_end_bound or below_end_bound:
        return "angle"
    if abs(requested) > magnitude_limit:
        return magnitude_name
    return rate_name
