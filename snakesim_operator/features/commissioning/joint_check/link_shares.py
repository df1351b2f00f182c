"""Measures how far each link turned while one joint moved, as a fraction of what that joint's encoder measured. Pure.

The difference of the fractions of the links on both sides of joint k is the motion that the links made at joint k. On a
robot that matches its file, it is 1 at the joint that moves. At other joints it is only what the encoder there
measured, too, because held joints give way a little. Two modules whose ids are swapped break this pattern, and
exchanging them restores it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.joint_check.measurements import (
    PITCH,
    YAW,
    CheckMeasurements,
    Mask,
)

MIN_RATE_RAD_S = 0.02  # slower samples tell nothing
MIN_SAMPLES = 8
MIN_SWAP_MISFIT = 0.1  # sum of squared fractions; two modules with less are not taken for swapped
MAX_REMAINING_MISFIT = 0.25  # fraction of the misfit that may be left if a swap explains it
EXCLUDED_MISFIT = 0.4  # a swap that makes the misfit this much larger is excluded
ModuleOrder = NDArray[np.intp]  # order[i]: the joint whose module is in the place of joint i


@dataclass(frozen=True)
class LinkMotionFractions:
    """What was measured while one joint moved, as fractions of that joint's motion by its encoder; NaN: unknown."""

    links: Floats  # (links, joints): of each link, about the axis of each joint
    across: Floats  # (links, joints): of each link, across the axis of each joint: about z for pitch, about y for yaw
    encoders: Floats  # (joints,): in each joint's encoder

    def compute_joint_motions(self) -> Floats:
        """Return the motion that the links made at each joint, from the links on both sides of it, (joints,)."""
        return np.diagonal(self.links[1:]) - np.diagonal(self.links)

    def reorder_modules(self, order: ModuleOrder) -> "LinkMotionFractions":
        """Return the fractions as if the module of joint order[i] were in the place of joint i.

        A module is its encoder, and its IMU, which is on the link ahead of the joint.
        """
        links = [0, *(order + 1)]  # link 0 has no module; link k + 1 is ahead of joint k
        return LinkMotionFractions(self.links[links], self.across[links], self.encoders[order])

    def compute_misfit(self) -> float:
        """Return by how much the IMUs disagree with the encoders: a sum of squared fractions."""
        return float(np.nansum((self.compute_joint_motions() - self.encoders) ** 2))

    def compute_misfit_at_other_joints(self, place: int) -> float:
        """Return the misfit at all joints but one, whose sign and gear may be wrong, and across the axes of all."""
        motion_across = np.diagonal(self.across[1:]) - np.diagonal(self.across)
        elsewhere = np.delete(self.compute_joint_motions() - self.encoders, place)
        return float(np.nansum(elsewhere**2) + np.nansum(motion_across**2))


def measure_link_motion_fractions(
    measurements: CheckMeasurements, joint_index: int
) -> LinkMotionFractions:
    """Measure the motion of all links and encoders while one joint moved, as fractions of that joint's motion."""
    is_commanded = measurements.is_in_large_motion(joint_index)
    speed_rad_s = measurements.velocity_rad_s[:, joint_index]
    is_moving = is_commanded & (np.abs(speed_rad_s) > MIN_RATE_RAD_S)
    encoder_fractions = np.array(
        [_fit_fraction(rate, speed_rad_s, is_moving) for rate in measurements.velocity_rad_s.T]
    )
    along_axes = [measurements.find_axis_component(k) for k in range(len(measurements.axes))]
    across_axes = [YAW + PITCH - component for component in along_axes]
    return LinkMotionFractions(
        links=_compute_link_fractions(
            measurements, joint_index, is_commanded, is_moving, along_axes
        ),
        across=_compute_link_fractions(
            measurements, joint_index, is_commanded, is_moving, across_axes
        ),
        encoders=encoder_fractions,
    )


def _compute_link_fractions(
    measurements: CheckMeasurements,
    joint_index: int,
    is_commanded: Mask,
    is_moving: Mask,
    components: Sequence[int],
) -> Floats:
    """Return the motion of every link while one joint moved, as a fraction of that joint's motion by its encoder.

    A joint's axis is the same in the frames of both of its links, so their fractions about it may be subtracted. The
    fractions across the axis may be subtracted as long as the joint is nearly straight.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint that moved.
        is_commanded: (ticks,) whether the joint had a moving target.
        is_moving: (ticks,) whether the joint moved fast enough for a ratio of rates.
        components: For each joint of the robot, the component of the links' rates to use: about or across its axis.

    Returns:
        (links, joints), NaN where unknown.
    """
    speed_rad_s = measurements.velocity_rad_s[:, joint_index]
    fractions_by_component: dict[int, list[float]] = {}  # one fraction for each link
    for component in set(components):
        link_rates_rad_s = measurements.link_rate_rad_s[:, :, component].T
        fractions_by_component[component] = [
            _fit_fraction(rate, speed_rad_s, is_moving) for rate in link_rates_rad_s
        ]
    fractions = np.array([fractions_by_component[component] for component in components]).T
    if np.isnan(
        fractions[0]
    ).all():  # link 0 has no IMU; motion capture may have measured its angle
        angle_rad = _remove_mean(measurements.angle_rad[:, joint_index], is_commanded)
        for k, component in enumerate(components):
            base_rad = _remove_mean(measurements.base_rotation_rad[:, component], is_commanded)
            fractions[0, k] = _fit_fraction(base_rad, angle_rad, is_commanded)
    return fractions


def _remove_mean(signal: Floats, mask: Mask) -> Floats:
    return signal - np.mean(signal[mask])


def _fit_fraction(signal: Floats, reference: Floats, mask: Mask) -> float:
    """Return by least squares how much of a reference is in a signal; NaN if too little was measured."""
    is_known = mask & ~np.isnan(signal)
    if is_known.sum() < MIN_SAMPLES:
        return float("nan")
    return float(
        signal[is_known] @ reference[is_known] / (reference[is_known] @ reference[is_known])
    )


def find_module_order(motion_fractions: Sequence[LinkMotionFractions | None]) -> ModuleOrder:
    """Find joint modules whose ids are swapped, from the motion of the links while each joint moved.

    Repeatedly exchanges the pair of modules whose exchange leaves the smallest misfit between IMUs and encoders, as
    long as the exchange explains the motions of both joints. Both motions count together, because one alone may show
    little if the floor lets few links turn.

    Args:
        motion_fractions: Measurements while each joint moved; None where a joint did not move.

    Returns:
        For each joint, the index of the joint whose module is in its place.
    """
    order = np.arange(len(motion_fractions))
    pairs = [
        (j, k) for j in range(len(motion_fractions)) for k in range(j + 1, len(motion_fractions))
    ]
    while pairs:
        misfits = [
            _compute_total_misfit(motion_fractions, _swap_modules(order, *pair)) for pair in pairs
        ]
        best_pair = pairs[int(np.argmin(misfits))]
        swapped_order = _swap_modules(order, *best_pair)
        pair_fractions = [motion_fractions[joint] for joint in best_pair]
        misfit_before = _compute_total_misfit(pair_fractions, order)
        misfit_after = _compute_total_misfit(pair_fractions, swapped_order)
        if misfit_before < MIN_SWAP_MISFIT:
            break
        if misfit_after > MAX_REMAINING_MISFIT * misfit_before:
            break
        order = swapped_order
        pairs = [pair for pair in pairs if set(pair).isdisjoint(best_pair)]
    return order


def find_swap_candidates(
    motion_fractions: Sequence[LinkMotionFractions | None], order: ModuleOrder, joint_index: int
) -> list[int]:
    """Find the joints whose modules might be swapped with that of a joint, because their motions do not exclude it.

    Args:
        motion_fractions: Measurements while each joint moved; None where a joint did not move.
        order: Index of the joint whose module is in the place of each joint, as far as it is known.
        joint_index: Index of the joint.

    Returns:
        Indices of the other joints.
    """
    candidates: list[int] = []
    for other in range(len(motion_fractions)):
        if other == joint_index:
            continue
        swapped = _swap_modules(order, joint_index, other)
        additional_misfit = 0.0
        for mover in (joint_index, other):
            motion = motion_fractions[mover]
            if motion is not None:
                misfit_before = motion.reorder_modules(order).compute_misfit_at_other_joints(
                    _find_joint_of_module(order, mover)
                )
                additional_misfit += (
                    motion.reorder_modules(swapped).compute_misfit_at_other_joints(
                        _find_joint_of_module(swapped, mover)
                    )
                    - misfit_before
                )
        if additional_misfit < EXCLUDED_MISFIT:
            candidates.append(other)
    return candidates


def _find_joint_of_module(order: ModuleOrder, module: int) -> int:
    """Return the joint in whose place a module is."""
    return int(np.flatnonzero(order == module)[0])


def _compute_total_misfit(
    motion_fractions: Sequence[LinkMotionFractions | None], order: ModuleOrder
) -> float:
    return sum(
        motion.reorder_modules(order).compute_misfit()
        for motion in motion_fractions
        if motion is not None
    )


def _swap_modules(order: ModuleOrder, j: int, k: int) -> ModuleOrder:
    swapped = order.copy()
    swapped[[j, k]] = order[[k, j]]
    return swapped
