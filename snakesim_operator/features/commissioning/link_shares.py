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
from snakesim_operator.features.commissioning.measured import PITCH, YAW, CheckMeasurements, Select

MIN_RATE_RAD_S = 0.02  # slower samples tell nothing
MIN_SAMPLES = 8
MIN_SWAP_MISFIT = 0.1  # sum of squared fractions; two modules with less are not taken for swapped
MAX_REMAINING_MISFIT = 0.25  # fraction of the misfit that may be left if a swap explains it
EXCLUDED_MISFIT = 0.4  # a swap that makes the misfit this much larger is excluded
Order = NDArray[np.intp]  # order[i]: the joint whose module is in the place of joint i


@dataclass(frozen=True)
class LinkShares:
    """What was measured while one joint moved, as fractions of that joint's motion by its encoder; NaN: unknown."""

    links: Floats  # (links, joints): of each link, about the axis of each joint
    across: Floats  # (links, joints): of each link, across the axis of each joint: about z for pitch, about y for yaw
    seen: Floats  # (joints,): in each joint's encoder

    def motion_at_joints(self) -> Floats:
        """Return the motion that the links made at each joint, from the links on both sides of it, (joints,)."""
        return np.diagonal(self.links[1:]) - np.diagonal(self.links)

    def with_modules(self, order: Order) -> "LinkShares":
        """Return the fractions as if the module of joint order[i] were in the place of joint i.

        A module is its encoder, and its IMU, which is on the link ahead of the joint.
        """
        links = [0, *(order + 1)]
        return LinkShares(self.links[links], self.across[links], self.seen[order])

    def misfit(self) -> float:
        """Return by how much the IMUs disagree with the encoders: a sum of squared fractions."""
        return float(np.nansum((self.motion_at_joints() - self.seen) ** 2))

    def misfit_elsewhere(self, place: int) -> float:
        """Return the misfit at all joints but one, whose sign and gear may be wrong, and across the axes of all."""
        motion_across = np.diagonal(self.across[1:]) - np.diagonal(self.across)
        elsewhere = np.delete(self.motion_at_joints() - self.seen, place)
        return float(np.nansum(elsewhere**2) + np.nansum(motion_across**2))


def measure_link_shares(run: CheckMeasurements, joint: int) -> LinkShares:
    """Return what links and encoders measured while a joint moved."""
    commanded = run.moved_by_target(joint)
    speed = run.velocity_rad_s[:, joint]
    moving = commanded & (np.abs(speed) > MIN_RATE_RAD_S)
    seen = np.array([_fit_fraction(rate, speed, moving) for rate in run.velocity_rad_s.T])
    along_axes = [run.component(k) for k in range(len(run.axes))]
    across_axes = [YAW + PITCH - component for component in along_axes]
    return LinkShares(
        links=_fractions_of_links(run, joint, commanded, moving, along_axes),
        across=_fractions_of_links(run, joint, commanded, moving, across_axes),
        seen=seen,
    )


def _fractions_of_links(
    run: CheckMeasurements, joint: int, commanded: Select, moving: Select, components: Sequence[int]
) -> Floats:
    """Return the motion of every link while one joint moved, as a fraction of that joint's motion by its encoder.

    A joint's axis is the same in both of its links' frames, so that their fractions about it may be subtracted. Those
    across it may be, as long as the joint is nearly straight.

    Args:
        run: Measurements of the check.
        joint: Index of the joint that moved.
        commanded: (ticks,) where the joint had a moving target.
        moving: (ticks,) where it moved fast enough for a ratio of rates.
        components: For each joint of the robot, the component of the links' rates to use: about or across its axis.

    Returns:
        (links, joints), NaN where unknown.
    """
    speed_rad_s = run.velocity_rad_s[:, joint]
    fractions_by_component: dict[int, list[float]] = {}  # one fraction for each link
    for component in set(components):
        link_rates_rad_s = run.link_rate_rad_s[:, :, component].T
        fractions_by_component[component] = [_fit_fraction(rate, speed_rad_s, moving) for rate in link_rates_rad_s]
    fractions = np.array([fractions_by_component[component] for component in components]).T
    if np.isnan(fractions[0]).all():  # link 0 has no IMU; motion capture may have measured its angle
        angle_rad = _remove_mean(run.angle_rad[:, joint], commanded)
        for k, component in enumerate(components):
            base_rad = _remove_mean(run.base_turn_rad[:, component], commanded)
            fractions[0, k] = _fit_fraction(base_rad, angle_rad, commanded)
    return fractions


def _remove_mean(signal: Floats, where: Select) -> Floats:
    return signal - np.mean(signal[where])


def _fit_fraction(signal: Floats, reference: Floats, where: Select) -> float:
    """Return by least squares how much of a reference is in a signal; NaN if too little was measured."""
    known = where & ~np.isnan(signal)
    if known.sum() < MIN_SAMPLES:
        return float("nan")
    return float(signal[known] @ reference[known] / (reference[known] @ reference[known]))


def find_order(motions: Sequence[LinkShares | None]) -> Order:
    """Find joint modules whose ids are swapped, from the motion of the links while each joint moved.

    Repeatedly exchanges the pair of modules whose exchange leaves the smallest misfit between IMUs and encoders, as
    long as the exchange explains the motions of both joints. Both motions count together, because one alone may show
    little if the floor lets few links turn.

    Args:
        motions: What was measured while each joint moved; None where a joint did not move.

    Returns:
        For each joint, the index of the joint whose module is in its place.
    """
    order = np.arange(len(motions))
    pairs = [(j, k) for j in range(len(motions)) for k in range(j + 1, len(motions))]
    while pairs:
        misfits = [_total_misfit(motions, _with_swap(order, *pair)) for pair in pairs]
        best_pair = pairs[int(np.argmin(misfits))]
        swapped_order = _with_swap(order, *best_pair)
        pair_motions = [motions[joint] for joint in best_pair]
        misfit_before = _total_misfit(pair_motions, order)
        misfit_after = _total_misfit(pair_motions, swapped_order)
        if misfit_before < MIN_SWAP_MISFIT:
            break
        if misfit_after > MAX_REMAINING_MISFIT * misfit_before:
            break
        order = swapped_order
        pairs = [pair for pair in pairs if set(pair).isdisjoint(best_pair)]
    return order


def swap_candidates(motions: Sequence[LinkShares | None], order: Order, joint: int) -> list[int]:
    """Return the joints whose modules might be swapped with that of a joint: their motions do not exclude it."""
    candidates: list[int] = []
    for other in range(len(motions)):
        if other == joint:
            continue
        swapped = _with_swap(order, joint, other)
        additional_misfit = 0.0
        for mover in (joint, other):
            motion = motions[mover]
            if motion is not None:
                as_wired = motion.with_modules(order).misfit_elsewhere(_place(order, mover))
                additional_misfit += motion.with_modules(swapped).misfit_elsewhere(_place(swapped, mover)) - as_wired
        if additional_misfit < EXCLUDED_MISFIT:
            candidates.append(other)
    return candidates


def _place(order: Order, module: int) -> int:
    """Return the joint in whose place a module is."""
    return int(np.flatnonzero(order == module)[0])


def _total_misfit(motions: Sequence[LinkShares | None], order: Order) -> float:
    return sum(motion.with_modules(order).misfit() for motion in motions if motion is not None)


def _with_swap(order: Order, j: int, k: int) -> Order:
    swapped = order.copy()
    swapped[[j, k]] = order[[k, j]]
    return swapped
