"""Measures from the torque of a joint whether the teeth of its gear touch all the time, without IMUs. Pure.

Backlash is crossed only while the gear carries no load. So the load of a joint that reverses bounds its backlash:

    load from one sign to the other   the drive turned so far meanwhile; the backlash is at most that angle
    load never reverses               the teeth may have touched on one side only, and nothing is excluded
    no load at one end of the stroke  the drive left the teeth there, and did not meet the teeth on the other side

The torque of a drive contains the friction of the drive, which the teeth do not carry. The torque that the links exert
is never smaller while the joint moves towards it than while it moves back. So at no angle do the torques of the two
directions differ by less than twice the friction.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from snakesim_hal.base.arrays import Floats

# The inertia of an emulated rotor reaches 0.03 N·m when the small motion reverses. The zero of a torque may be off by
# as much.
MIN_LOAD_NM = 0.03
# The largest torque without a load in the middle of a motion, where the rotor does not accelerate. Emulated joints
# reach 0.008 N·m.
MAX_UNLOADED_NM = 0.01
FRICTION_FACTOR = 1.5  # breakaway friction, divided by the friction of a joint that moves
FRICTION_BINS = 6  # of the stroke, in which both directions are compared
MIN_BIN_TICKS = 2  # of each direction
MEDIAN_TICKS = 5  # longer than the impulses when a motion begins, ends or reverses
# Torques are sampled, so begin and end of a stretch without a load are uncertain by one tick each.
UNCERTAIN_TICKS = 2
MIN_TARGET_STEP_RAD = 1e-9  # from tick to tick; less is a rounding error


@dataclass(frozen=True)
class ToothContact:
    """What the torque of a joint shows of the contact of its teeth."""

    friction_nm: float  # of the drive, an upper limit. The floor's friction may be a part of it
    load_threshold_nm: float  # a smaller torque does not prove a load
    # Angle in which the load reversed in the small motion, for the slowest of all reversals. None if the load did not
    # reverse in both directions.
    reversal_rad: float | None
    # Fraction of the small stroke from one of its ends in which the gear carried no load; 0 if none.
    unloaded_fraction: float
    max_load_nm: float  # in the small motion
    # Longest angle in the large motion in which the drive turned without a load in one direction.
    unloaded_travel_rad: float


@dataclass(frozen=True)
class JointMotion:
    """Angle, target and torque of a joint in one kind of motion, tick by tick; each (n,)."""

    angle_rad: Floats
    target_rad: Floats
    torque_nm: Floats
    direction: Floats  # of its angle: +1 or -1; 0 at rest


def measure_tooth_contact(
    small: JointMotion,
    second_cycle: JointMotion,
    large: JointMotion,
    *,
    noise_nm: float,
    angle_step_rad: float,
    window_ticks: int,
) -> ToothContact:
    """Measure the contact of the teeth of a joint.

    Args:
        small: All small motions. The torque is a moving average.
        second_cycle: The second cycle of the small motion, likewise.
        large: The large motions, with the torque as it was measured.
        noise_nm: Noise or resolution of the torque.
        angle_step_rad: Resolution of the encoder.
        window_ticks: Length of the moving average.
    """
    friction_nm = FRICTION_FACTOR * estimate_friction_nm(small)
    load_threshold_nm = MIN_LOAD_NM + noise_nm + friction_nm
    max_unloaded_nm = MAX_UNLOADED_NM + noise_nm + friction_nm
    reversal_rad = measure_reversal_rad(small, load_threshold_nm, margin_ticks=window_ticks // 2)
    if reversal_rad is not None:
        reversal_rad += angle_step_rad
    return ToothContact(
        friction_nm=friction_nm,
        load_threshold_nm=load_threshold_nm,
        reversal_rad=reversal_rad,
        unloaded_fraction=measure_unloaded_fraction(second_cycle, max_unloaded_nm),
        max_load_nm=float(np.max(np.abs(second_cycle.torque_nm))),
        unloaded_travel_rad=measure_unloaded_travel_rad(large, load_threshold_nm),
    )


def estimate_friction_nm(motion: JointMotion) -> float:
    """Return an upper limit of a drive's friction: half the smallest difference between both directions.

    The stroke is divided into bins of the angle. Infinite if no bin contains both directions, so that no torque proves
    a load.
    """
    edges_rad = np.linspace(np.min(motion.angle_rad), np.max(motion.angle_rad), FRICTION_BINS + 1)
    bins = np.clip(np.digitize(motion.angle_rad, edges_rad) - 1, 0, FRICTION_BINS - 1)
    differences_nm: list[float] = []
    for number in range(FRICTION_BINS):
        forward_nm = motion.torque_nm[(bins == number) & (motion.direction > 0)]
        backward_nm = motion.torque_nm[(bins == number) & (motion.direction < 0)]
        if min(len(forward_nm), len(backward_nm)) >= MIN_BIN_TICKS:
            differences_nm.append(float(np.mean(forward_nm) - np.mean(backward_nm)))
    return max(0.0, min(differences_nm, default=float("inf"))) / 2


def measure_reversal_rad(
    motion: JointMotion, load_threshold_nm: float, *, margin_ticks: int
) -> float | None:
    """Return the angle through which the joint moved while its load reversed, for the slowest of all reversals.

    Args:
        motion: The motion of the joint.
        load_threshold_nm: A smaller torque does not prove a load.
        margin_ticks: By which each reversal is extended, because the torque is a moving average.

    Returns:
        The angle; None if the load did not reverse in both directions.
    """
    sides = np.where(np.abs(motion.torque_nm) >= load_threshold_nm, np.sign(motion.torque_nm), 0.0)
    loaded_ticks = np.flatnonzero(sides)
    largest_rad = {1.0: 0.0, -1.0: 0.0}  # by the sign of the load after the reversal
    has_reversed = {1.0: False, -1.0: False}
    for last_tick, tick in pairwise(loaded_ticks.tolist()):
        side = float(sides[tick])
        if side == sides[last_tick]:
            continue
        start = max(last_tick - margin_ticks, 0)
        angle_rad = float(np.ptp(motion.angle_rad[start : tick + margin_ticks + 1]))
        largest_rad[side] = max(largest_rad[side], angle_rad)
        has_reversed[side] = True
    if not all(has_reversed.values()):
        return None
    return max(largest_rad.values())


def measure_unloaded_fraction(motion: JointMotion, max_unloaded_nm: float) -> float:
    """Return the fraction of the stroke, from one of its ends, in which the torque never exceeds a limit.

    The end with the larger fraction counts. 1 if the joint was never loaded.
    """
    start_rad = float(np.min(motion.angle_rad))
    stroke_rad = float(np.ptp(motion.angle_rad))
    loaded_rad = motion.angle_rad[np.abs(motion.torque_nm) > max_unloaded_nm]
    if not len(loaded_rad) or stroke_rad == 0.0:
        return 1.0
    at_start_rad = float(np.min(loaded_rad)) - start_rad
    at_end_rad = start_rad + stroke_rad - float(np.max(loaded_rad))
    return max(at_start_rad, at_end_rad) / stroke_rad


def measure_unloaded_travel_rad(motion: JointMotion, load_threshold_nm: float) -> float:
    """Return the longest angle through which the joint moved in one direction without a load, shortened by its error.

    Args:
        motion: The motion of the joint.
        load_threshold_nm: A smaller torque does not prove a load.
    """
    is_unloaded = np.abs(_compute_moving_median(motion.torque_nm)) < load_threshold_nm
    longest_rad = 0.0
    start: int | None = None  # of the present stretch without a load
    last_direction = 0.0  # of the target, before it came to rest if it rests
    for tick, direction in enumerate(_find_target_directions(motion.target_rad)):
        is_reversed = direction == -last_direction != 0.0
        if direction != 0.0:
            last_direction = direction
        if not is_unloaded[tick]:
            start = None
            continue
        if start is None or is_reversed:
            start = tick
        stretch_rad = motion.angle_rad[start : tick + 1]
        max_step_rad = float(np.max(np.abs(np.diff(stretch_rad)), initial=0.0))
        travel_rad = abs(float(stretch_rad[-1] - stretch_rad[0]))
        longest_rad = max(longest_rad, travel_rad - UNCERTAIN_TICKS * max_step_rad)
    return longest_rad


def _find_target_directions(target_rad: Floats) -> list[float]:
    """Return the direction in which a target moves, +1 or -1, and 0 at rest, for each tick."""
    steps_rad = np.diff(target_rad, prepend=target_rad[0])
    return np.where(np.abs(steps_rad) > MIN_TARGET_STEP_RAD, np.sign(steps_rad), 0.0).tolist()


def _compute_moving_median(signal: Floats) -> Floats:
    """Return the moving median of a signal; the first and the last value are repeated beyond the ends."""
    padded = np.pad(signal, MEDIAN_TICKS // 2, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, MEDIAN_TICKS), axis=-1)
