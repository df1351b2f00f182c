"""Limits the commands of many simulated robots at once: `snakesim_hal.safety.limiter.limit_command` on arrays.

Real robots use the limiter of the HAL. This one gives the same bits for commands in which all joints of all robots have
one mode, and had it in the period before; a test compares the two over random commands. Every array has the shape
(robots, joints), and every robot may have limits of its own.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.limiter import MIN_SPEED_LIMIT_RAD_S, REACTION_PERIODS
from snakesim_hal.wire.messages import JointMode, RobotDescription

Masks = NDArray[np.bool_]  # (robots, joints)
# Names of limits, as `limit_names.find_active_limits` gives them. An array of limits holds indices of this list.
LIMIT_NAMES = (
    "",
    "angle",
    "angle_rate",
    "speed",
    "acceleration",
    "torque",
    "torque_rate",
    "thermal",
    "isolated",
)
NO_LIMIT, ANGLE, ANGLE_RATE, SPEED, ACCELERATION, TORQUE, TORQUE_RATE, THERMAL, _ = range(
    len(LIMIT_NAMES)
)


@dataclass(frozen=True)
class LimitArrays:
    """The limits of robots as their descriptions state them, (robots, joints)."""

    period_s: float
    angle_min_rad: Floats
    angle_max_rad: Floats
    angle_rate_rad: Floats  # maximum change of an angle target in a period
    speed_rad_s: Floats
    acceleration_rad_s2: Floats
    torque_nm: Floats
    torque_rate_nm_s: Floats
    velocity_gain: Floats  # N·m·s/rad, of the torque bounds near the ends
    # Minimum and maximum distance of an angle target from the measured angle, (2, robots, joints).
    step_bounds_rad: Floats

    @staticmethod
    def allocate(robot_count: int, joint_count: int, period_s: float) -> "LimitArrays":
        """Return arrays of placeholder limits, which `set_robot` fills in."""
        shape = (robot_count, joint_count)
        step_bounds_rad = np.ones((2, *shape))
        return LimitArrays(
            period_s, *(np.ones(shape) for _ in range(8)), step_bounds_rad=step_bounds_rad
        )

    def set_robot(self, robot_index: int, description: RobotDescription) -> None:
        """Fill in the limits of one robot."""
        for i, joint in enumerate(description.joints):
            max_speed = max(joint.speed_limit_rad_s, MIN_SPEED_LIMIT_RAD_S)
            self.angle_min_rad[robot_index, i] = joint.angle_min_rad
            self.angle_max_rad[robot_index, i] = joint.angle_max_rad
            self.step_bounds_rad[0, robot_index, i] = -description.max_step_rad
            self.step_bounds_rad[1, robot_index, i] = description.max_step_rad
            self.angle_rate_rad[robot_index, i] = joint.speed_limit_rad_s * self.period_s
            self.speed_rad_s[robot_index, i] = joint.speed_limit_rad_s
            self.acceleration_rad_s2[robot_index, i] = joint.acceleration_limit_rad_s2
            self.torque_nm[robot_index, i] = joint.torque_limit_nm
            self.torque_rate_nm_s[robot_index, i] = joint.torque_rate_limit_nm_s
            self.velocity_gain[robot_index, i] = max(
                joint.velocity_gain_nm_s_per_rad, joint.torque_limit_nm / max_speed
            )


class MeasuredArrays(NamedTuple):
    """The measured states of the joints, (robots, joints) each."""

    angle_rad: Floats
    velocity_rad_s: Floats


def limit_torque_limits(
    last_limit_nm: Floats, torque_fraction: Floats, limits: LimitArrays
) -> Floats:
    """Return the torque limits that apply in this period, for commands that request full torque.

    A torque limit rises by no more than the torque rate allows, and never exceeds the derated torque.

    Args:
        last_limit_nm: Torque limits of the last period, (robots, joints).
        torque_fraction: Fraction from 0 to 1 that derating leaves of each torque limit, (robots, joints).
        limits: Limits of the robots.
    """
    derated_nm = limits.torque_nm * torque_fraction
    rate_limited_nm = last_limit_nm + limits.torque_rate_nm_s * limits.period_s
    max_limit_nm = np.where(rate_limited_nm < derated_nm, rate_limited_nm, derated_nm)
    return _clamp(limits.torque_nm, np.zeros_like(derated_nm), max_limit_nm)


def limit_targets(
    mode: JointMode,
    requested: Floats,
    last_target: Floats,
    torque_limit_nm: Floats,
    measured: MeasuredArrays,
    limits: LimitArrays,
) -> Floats:
    """Return the targets within all limits that are nearest to the requested targets, (robots, joints).

    If no target has to be changed, that is the array `requested` itself.

    Args:
        mode: Control mode of all joints. PASSIVE is not allowed.
        requested: Targets of the commands, in rad, rad/s or N·m depending on the mode.
        last_target: Limited targets of the last period, in the same mode.
        torque_limit_nm: Torque limits of this period.
        measured: Last plausible states of the joints.
        limits: Limits of the robots.

    Raises:
        ValueError: The mode is PASSIVE.
    """
    match mode:
        case JointMode.POSITION:
            # Both bounds in one array, because that takes half as many calls.
            low, high = _clamp(
                measured.angle_rad + limits.step_bounds_rad,
                limits.angle_min_rad,
                limits.angle_max_rad,
            )
            max_change = limits.angle_rate_rad
        case JointMode.VELOCITY:
            low, high = _compute_velocity_bounds(measured, limits)
            low = _clamp(low, -limits.speed_rad_s, limits.speed_rad_s)
            high = _clamp(high, -limits.speed_rad_s, limits.speed_rad_s)
            max_change = limits.acceleration_rad_s2 * limits.period_s
        case JointMode.TORQUE:
            low, high = _compute_torque_bounds(measured, limits)
            low = _clamp(low, -torque_limit_nm, torque_limit_nm)
            high = _clamp(high, -torque_limit_nm, torque_limit_nm)
            max_change = limits.torque_rate_nm_s * limits.period_s
        case JointMode.PASSIVE:
            raise ValueError("passive joints have no targets")
    # The same array as in the last period: all targets have been reached, and none changes.
    if last_target is not requested:
        requested = _clamp(requested, last_target - max_change, last_target + max_change)
    return _clamp(requested, low, high)


def find_active_limit_indices(
    mode: JointMode,
    requested: Floats,
    target: Floats,
    torque_limit_nm: Floats,
    torque_fraction: Floats,
    measured: MeasuredArrays,
    limits: LimitArrays,
) -> NDArray[np.int64]:
    """Return the index in LIMIT_NAMES of the tightest limit that each requested target exceeds.

    Args:
        mode: Control mode of all joints.
        requested: Targets before the limiter.
        target: Targets after the limiter.
        torque_limit_nm: Torque limits of this period.
        torque_fraction: Fraction that derating leaves of each torque limit.
        measured: Joint states that the limiter used.
        limits: Limits of the robots.
    """
    if mode is JointMode.POSITION:
        is_within_ends = (limits.angle_min_rad <= requested) & (requested <= limits.angle_max_rad)
        limit_indices = np.where(is_within_ends, ANGLE_RATE, ANGLE)
    else:
        if mode is JointMode.VELOCITY:
            low, high = _compute_velocity_bounds(measured, limits)
            max_magnitude = limits.speed_rad_s
            magnitude_index = SPEED
            rate_index = ACCELERATION
        else:
            low, high = _compute_torque_bounds(measured, limits)
            max_magnitude = torque_limit_nm
            magnitude_index = TORQUE
            rate_index = TORQUE_RATE
        # The bounds near the ends of a joint are the tighter ones where they are within the maximum magnitude.
        is_above_end_bound = (requested > high) & (high < max_magnitude)
        is_below_end_bound = (requested < low) & (low > -max_magnitude)
        limit_indices = np.where(np.abs(requested) > max_magnitude, magnitude_index, rate_index)
        limit_indices = np.where(is_above_end_bound | is_below_end_bound, ANGLE, limit_indices)
    limit_indices = np.where(target != requested, limit_indices, NO_LIMIT)
    is_derated = limits.torque_nm > limits.torque_nm * torque_fraction
    return np.where(
        is_derated & ((limit_indices == NO_LIMIT) | (limit_indices == TORQUE)),
        THERMAL,
        limit_indices,
    )


def _compute_velocity_bounds(
    measured: MeasuredArrays, limits: LimitArrays
) -> tuple[Floats, Floats]:
    """Return the minimum and maximum velocities from which joints can stop before their ends."""
    to_lower_end, to_upper_end = _compute_stoppable_speeds(measured, limits)
    return -to_lower_end, to_upper_end


def _compute_torque_bounds(measured: MeasuredArrays, limits: LimitArrays) -> tuple[Floats, Floats]:
    """Return the minimum and maximum torques that keep joints between their ends, in N·m, (robots, joints) each.

    The bounds brake a joint to the speed from which it can stop before the end that it approaches.
    """
    lower_end_speed_rad_s, upper_end_speed_rad_s = _compute_stoppable_speeds(measured, limits)
    gain = limits.velocity_gain
    low_nm = -gain * (lower_end_speed_rad_s + measured.velocity_rad_s)
    high_nm = gain * (upper_end_speed_rad_s - measured.velocity_rad_s)

    # At an end, or beyond it, no torque may push further outward.
    is_at_lower_end = lower_end_speed_rad_s == 0.0
    is_at_upper_end = upper_end_speed_rad_s == 0.0
    low_nm = np.where(is_at_lower_end & (low_nm < 0.0), 0.0, low_nm)
    high_nm = np.where(is_at_upper_end & (high_nm > 0.0), 0.0, high_nm)

    # Bounds that cross, as between two near ends, become equal: at the upper end to the upper one, otherwise to the
    # lower one.
    is_crossed = high_nm < low_nm
    return (
        np.where(is_at_upper_end & is_crossed, high_nm, low_nm),
        np.where(is_at_upper_end | (high_nm > low_nm), high_nm, low_nm),
    )


def _compute_stoppable_speeds(
    measured: MeasuredArrays, limits: LimitArrays
) -> tuple[Floats, Floats]:
    """Return the maximum speeds from which joints can stop before their lower and upper ends."""
    to_lower_end = _compute_stoppable_speed(measured.angle_rad - limits.angle_min_rad, limits)
    to_upper_end = _compute_stoppable_speed(limits.angle_max_rad - measured.angle_rad, limits)
    return to_lower_end, to_upper_end


def _compute_stoppable_speed(distance_rad: Floats, limits: LimitArrays) -> Floats:
    """Return the maximum speeds from which joints can stop within distances, as `limiter.stoppable_speed` does."""
    reaction_s = REACTION_PERIODS * limits.period_s
    acceleration = limits.acceleration_rad_s2
    ahead_rad = np.maximum(distance_rad, 0.0)
    speed = acceleration * (np.sqrt(reaction_s**2 + 2.0 * ahead_rad / acceleration) - reaction_s)
    return np.where(distance_rad <= 0.0, 0.0, speed)


def _clamp(value: Floats, low: Floats, high: Floats) -> Floats:
    """Return the values within bounds: the same array if all of them are.

    Unlike `np.clip` it keeps the sign of a zero that equals its bound.
    """
    is_above = value > high
    is_below = value < low
    # Usually no value is out of bounds, and counting is faster than copying.
    if not np.count_nonzero(is_above) and not np.count_nonzero(is_below):
        return value
    clamped: Any = value.copy()
    np.copyto(clamped, high, where=is_above)
    np.copyto(clamped, low, where=is_below)
    return clamped
