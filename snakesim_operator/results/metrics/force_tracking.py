"""Whether the forces that a controller asked of obstacles came true: solved against measured, contact by contact.

A force that is asked for now is felt by the controller later: the command needs its time on the way, the sensor, too,
and what is felt is a mean over 50 ms. So each measured force is held against what was asked of the same obstacle a
moment before. While the body does not move, the ground's friction takes any difference, and of
less than ASKED_N always may.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import ControlState, WorldContact

DELAY_S = 0.06  # from the setpoint to the mean that shows it
ASKED_N = 1.0  # about a quarter of the drag of the shipped robots: less is not judged
EMPTY_N = 0.1  # less than this is no contact
FEWEST = 20  # pairs from which a correlation is told


@dataclass(frozen=True)
class Pair:
    """One push-point at one moment of locomotion."""

    timestamp_ns: int
    obstacle: str
    desired_force_n: float
    measured_force_n: float


@dataclass(frozen=True)
class ForceTracking:
    """How well the measured forces follow the solved ones, at the push-points of a body that locomotes."""

    correlation: float | None  # of measured with solved; None: too few, or all the same
    median_error: float  # |measured - solved| over solved
    empty: float  # share of those that carry nothing


def is_measured(push_point: WorldContact, contacts: Iterable[WorldContact]) -> bool:
    """Whether one of the measured contacts is on the push-point's obstacle.

    Elsewhere the force that a controller has solved for is asked for, and not there.
    """
    return any(contact.obstacle == push_point.obstacle for contact in contacts)


def pairs(states: Sequence[ControlState]) -> list[Pair]:
    """Solved and measured forces of all push-points while the body locomotes; in order of time."""
    found: list[Pair] = []
    before = 0
    for state in states:
        if state.state != "Locomoting" or len(state.measured_force_n) != len(state.push_points):
            continue
        asked_ns = state.timestamp_ns - round(DELAY_S * 1e9)
        while before + 1 < len(states) and states[before + 1].timestamp_ns <= asked_ns:
            before += 1
        then = states[before]
        if not asked_ns - round(DELAY_S * 1e9) <= then.timestamp_ns <= asked_ns:
            continue
        asked = {point.obstacle: n for point, n in zip(then.push_points, then.desired_force_n, strict=False)}
        for point, measured_force_n in zip(state.push_points, state.measured_force_n, strict=True):
            desired_force_n = asked.get(point.obstacle, 0.0)
            if point.obstacle is not None and measured_force_n is not None and desired_force_n >= ASKED_N:
                found.append(Pair(state.timestamp_ns, point.obstacle, desired_force_n, measured_force_n))
    return found


def force_tracking(states: Sequence[ControlState]) -> ForceTracking | None:
    """None when nothing was asked for while the body locomoted, or no sensor told what was felt."""
    found = pairs(states)
    if not found:
        return None
    solved, felt = np.array([(pair.desired_force_n, pair.measured_force_n) for pair in found]).T
    return ForceTracking(
        correlation=_correlation(solved, felt),
        median_error=float(np.median(np.abs(felt - solved) / solved)),
        empty=float(np.mean(felt < EMPTY_N)),
    )


def _correlation(solved: Floats, felt: Floats) -> float | None:
    if len(solved) < FEWEST or solved.std() < 1e-9 or felt.std() < 1e-9:
        return None
    return float(np.corrcoef(solved, felt)[0, 1])
