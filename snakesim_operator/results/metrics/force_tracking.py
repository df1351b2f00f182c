"""Whether contact forces followed the ones that a controller requested: desired against measured, by contact.

The controller measures a force some time after it requested it: the command and the sensor have latencies, and the
measured force is a mean over 50 ms. So each measured force is compared with the one that was requested at the same
obstacle a moment before. While the body does not move, the friction of the ground takes any difference, so only
locomotion counts; a request of less than ASKED_N does not count either.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import ControlState, WorldContact

DELAY_S = 0.06  # from the setpoint to the mean in which it appears
ASKED_N = 1.0  # about a quarter of the drag of the shipped robots: less is not judged
EMPTY_N = 0.1  # less than this is no contact
MIN_PAIRS = 20  # a correlation of fewer means nothing


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
    """Return whether one of the measured contacts is on the push-point's obstacle.

    Otherwise the force that the controller solved for is only requested.
    """
    return any(contact.obstacle == push_point.obstacle for contact in contacts)


def pairs(states: Sequence[ControlState]) -> list[Pair]:
    """Pair each measured push-point force with the force that the controller requested there DELAY_S earlier.

    The request is the newest message that is at least DELAY_S and at most twice DELAY_S older than the measurement.
    Push-points match by their obstacle. Desired forces below ASKED_N are left out.

    Args:
        states: The controller's messages, in order of time.

    Returns:
        The pairs of all push-points while the body locomotes, in order of time.
    """
    delay_ns = round(DELAY_S * 1e9)
    matched: list[Pair] = []
    request_index = 0
    for state in states:
        has_all_forces = len(state.measured_force_n) == len(state.push_points)
        if state.state != "Locomoting" or not has_all_forces:
            continue
        requested_ns = state.timestamp_ns - delay_ns
        while request_index + 1 < len(states) and states[request_index + 1].timestamp_ns <= requested_ns:
            request_index += 1
        request = states[request_index]
        if not requested_ns - delay_ns <= request.timestamp_ns <= requested_ns:
            continue
        desired_n_by_obstacle: dict[str | None, float] = {}
        for point, force_n in zip(request.push_points, request.desired_force_n, strict=False):
            desired_n_by_obstacle[point.obstacle] = force_n
        for point, measured_n in zip(state.push_points, state.measured_force_n, strict=True):
            if point.obstacle is None or measured_n is None:
                continue
            desired_n = desired_n_by_obstacle.get(point.obstacle, 0.0)
            if desired_n >= ASKED_N:
                matched.append(Pair(state.timestamp_ns, point.obstacle, desired_n, measured_n))
    return matched


def force_tracking(states: Sequence[ControlState]) -> ForceTracking | None:
    """Return how well the measured forces follow the desired ones.

    None if the controller requested no force during locomotion, or no sensor measured any.
    """
    compared = pairs(states)
    if not compared:
        return None
    solved, measured = np.array([(pair.desired_force_n, pair.measured_force_n) for pair in compared]).T
    return ForceTracking(
        correlation=_correlation(solved, measured),
        median_error=float(np.median(np.abs(measured - solved) / solved)),
        empty=float(np.mean(measured < EMPTY_N)),
    )


def _correlation(solved: Floats, measured: Floats) -> float | None:
    if len(solved) < MIN_PAIRS or solved.std() < 1e-9 or measured.std() < 1e-9:
        return None
    return float(np.corrcoef(solved, measured)[0, 1])
