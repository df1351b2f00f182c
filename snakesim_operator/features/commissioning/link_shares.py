"""How far each link turned while one joint moved, as a share of what that joint's encoder measured. Pure.

The difference of the shares of the links on both sides of joint k is what turned up at joint k. On a robot that is as
its file says, that is 1 at k = j, the joint that moves, and elsewhere only what the encoder there measured, too,
because held joints give way a little. Two modules whose ids are swapped break this pattern, and exchanging them
restores it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.measured import PITCH, YAW, Measured, Select

MOVES_RAD_S = 0.02  # slower samples tell nothing
LEAST_SAMPLES = 8
MISFIT = 0.1  # sum of squared shares that no IMU should have seen, from which two modules may have been swapped
BETTER = 0.25  # of the misfit is left, if they were
EXCLUDED = 0.4  # more misfit than as wired: the swap of two modules is excluded
Order = NDArray[np.intp]


@dataclass(frozen=True)
class LinkShares:
    """What was measured while one joint moved, as shares of that joint's motion by its encoder; NaN: unknown."""

    links: Floats  # (links, joints): of each link, about the axis of each joint
    across: Floats  # (links, joints): of each link, across the axis of each joint: about z for pitch, about y for yaw
    seen: Floats  # (joints,): in each joint's encoder

    def turned(self) -> Floats:
        """Return what turned up at each joint, from the links on both sides of it, (joints,)."""
        return np.diagonal(self.links[1:]) - np.diagonal(self.links)

    def with_modules(self, order: Order) -> "LinkShares":
        """The module of joint order[i] in joint i's place: its encoder, and its IMU, on the link ahead of the joint."""
        links = [0, *(order + 1)]
        return LinkShares(self.links[links], self.across[links], self.seen[order])

    def misfit(self) -> float:
        """Return what the IMUs measured otherwise than the encoders: a sum of squared shares."""
        return float(np.nansum((self.turned() - self.seen) ** 2))

    def misfit_elsewhere(self, place: int) -> float:
        """Return the misfit at all joints but one, whose sign and gear may be wrong, and across the axes of all."""
        turned_across = np.diagonal(self.across[1:]) - np.diagonal(self.across)
        elsewhere = np.delete(self.turned() - self.seen, place)
        return float(np.nansum(elsewhere**2) + np.nansum(turned_across**2))


def link_shares(run: Measured, joint: int) -> LinkShares:
    """Return what links and encoders did while a joint moved."""
    moved = run.moved_by_target(joint)
    speed = run.velocity_rad_s[:, joint]
    moves = moved & (np.abs(speed) > MOVES_RAD_S)
    seen = np.array([_share(rate, speed, moves) for rate in run.velocity_rad_s.T])
    components = [run.component(k) for k in range(len(run.axes))]
    across = [YAW + PITCH - component for component in components]
    return LinkShares(
        links=_shares_of_links(run, joint, moved, moves, components),
        across=_shares_of_links(run, joint, moved, moves, across),
        seen=seen,
    )


def _shares_of_links(run: Measured, joint: int, moved: Select, moves: Select, components: Sequence[int]) -> Floats:
    """Return how much of the joint's motion each link made about an axis of each joint, (links, joints).

    A joint's axis is the same in both of its links' frames, so that their shares about it may be subtracted. Those
    across it may be, as long as the joint is nearly straight.
    """
    speed = run.velocity_rad_s[:, joint]
    by_component = {
        at: [_share(rate, speed, moves) for rate in run.link_rate_rad_s[:, :, at].T] for at in set(components)
    }
    shares = np.array([by_component[at] for at in components]).T
    if np.isnan(shares[0]).all():
        angle_rad = _about_mean(run.angle_rad[:, joint], moved)
        shares[0] = [_share(_about_mean(run.base_turn_rad[:, at], moved), angle_rad, moved) for at in components]
    return shares


def _about_mean(signal: Floats, where: Select) -> Floats:
    return signal - np.mean(signal[where])


def _share(rate: Floats, speed: Floats, moves: Select) -> float:
    """Return by least squares how much of `speed` is in `rate`; NaN when too little was measured."""
    known = moves & ~np.isnan(rate)
    if known.sum() < LEAST_SAMPLES:
        return float("nan")
    return float(rate[known] @ speed[known] / (speed[known] @ speed[known]))


def find_order(motions: Sequence[LinkShares | None]) -> Order:
    """Return whose module is in the place of each joint's: swaps of two, as long as one makes both motions fit.

    Both motions are asked together: one alone may tell little, when the floor lets few links turn. A motion is None
    where a joint did not move.
    """
    order = np.arange(len(motions))
    pairs = [(j, k) for j in range(len(motions)) for k in range(j + 1, len(motions))]
    while pairs:
        misfits = [_misfit(motions, _with_swap(order, *pair)) for pair in pairs]
        best = pairs[int(np.argmin(misfits))]
        swapped = _with_swap(order, *best)
        own = [motions[j] for j in best]
        before = _misfit(own, order)
        if before < MISFIT or _misfit(own, swapped) > BETTER * before:
            break
        order = swapped
        pairs = [pair for pair in pairs if not {*pair} & {*best}]
    return order


def swap_candidates(motions: Sequence[LinkShares | None], order: Order, joint: int) -> list[int]:
    """Return the joints whose modules might be swapped with that of a joint: their motions do not exclude it."""
    candidates: list[int] = []
    for other in range(len(motions)):
        if other == joint:
            continue
        swapped = _with_swap(order, joint, other)
        more = 0.0
        for mover in (joint, other):
            motion = motions[mover]
            if motion is not None:
                as_wired = motion.with_modules(order).misfit_elsewhere(_place(order, mover))
                more += motion.with_modules(swapped).misfit_elsewhere(_place(swapped, mover)) - as_wired
        if more < EXCLUDED:
            candidates.append(other)
    return candidates


def _place(order: Order, module: int) -> int:
    """Return the joint in whose place a module is."""
    return int(np.flatnonzero(order == module)[0])


def _misfit(motions: Sequence[LinkShares | None], order: Order) -> float:
    return sum(motion.with_modules(order).misfit() for motion in motions if motion is not None)


def _with_swap(order: Order, j: int, k: int) -> Order:
    swapped = order.copy()
    swapped[[j, k]] = order[[k, j]]
    return swapped
