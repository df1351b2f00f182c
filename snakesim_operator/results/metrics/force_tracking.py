"""Compares the contact forces that a controller desired with the forces that were measured, contact by contact.

The controller measures a force some time after it requested it: the command and the sensor have latencies, and the
measured force is a mean over 50 ms. So each measured force is compared with the one that was requested at the same
obstacle a moment before. While the body does not move, ground friction balances any difference, so only locomotion
counts. A request of less than MIN_DESIRED_FORCE_N does not count either.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import ControlState, WorldContact

MEASUREMENT_DELAY_S = 0.06  # from the setpoint to the averaged measurement that contains it
# About a quarter of the drag of the bundled robots; a smaller desired force is ignored.
MIN_DESIRED_FORCE_N = 1.0
MIN_CONTACT_FORCE_N = 0.1  # a smaller measured force counts as no contact
MIN_PAIRS = 20  # a correlation of fewer pairs is meaningless


@dataclass(frozen=True)
class ForcePair:
    """Desired and measured force of one push-point at one time."""

    timestamp_ns: int
    obstacle: str
    desired_force_n: float
    measured_force_n: float


@dataclass(frozen=True)
class ForceTracking:
    """How well measured forces follow desired forces, over all push-points while the body locomotes."""

    correlation: float | None  # Pearson; None if there are too few pairs, or all forces are equal
    median_error: float  # |measured - desired| / desired
    no_contact_fraction: float  # fraction of push-points without a measured contact force


def is_contact_measured(push_point: WorldContact, contacts: Iterable[WorldContact]) -> bool:
    """Return whether one of the measured contacts is on the obstacle of a push-point.

    Args:
        push_point: A contact for which the controller desired a force.
        contacts: The measured contacts.
    """
    return any(contact.obstacle == push_point.obstacle for contact in contacts)


def pair_forces(states: Sequence[ControlState]) -> list[ForcePair]:
    """Pair each measured push-point force with the force desired there MEASUREMENT_DELAY_S earlier.

    The request is the newest message that is at least MEASUREMENT_DELAY_S and at most twice MEASUREMENT_DELAY_S older
    than the measurement. Push-points match by their obstacle. Desired forces below MIN_DESIRED_FORCE_N are left out.

    Args:
        states: The controller's messages, in order of time.

    Returns:
        The pairs of all push-points while the body locomotes, in order of time.
    """
    delay_ns = round(MEASUREMENT_DELAY_S * 1e9)
    force_pairs: list[ForcePair] = []
    request_index = 0
    for state in states:
        has_all_forces = len(state.measured_force_n) == len(state.push_points)
        if state.state != "Locomoting" or not has_all_forces:
            continue
        requested_ns = state.timestamp_ns - delay_ns
        while (
            request_index + 1 < len(states)
            and states[request_index + 1].timestamp_ns <= requested_ns
        ):
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
            if desired_n >= MIN_DESIRED_FORCE_N:
                force_pairs.append(
                    ForcePair(state.timestamp_ns, point.obstacle, desired_n, measured_n)
                )
    return force_pairs


def measure_force_tracking(states: Sequence[ControlState]) -> ForceTracking | None:
    """Measure how well the contact forces follow the forces that the controller desired.

    Args:
        states: The controller's messages, in order of time.

    Returns:
        The measures, or None if the controller desired no force during locomotion, or no sensor measured any.
    """
    force_pairs = pair_forces(states)
    if not force_pairs:
        return None
    desired_n, measured_n = np.array(
        [(pair.desired_force_n, pair.measured_force_n) for pair in force_pairs]
    ).T
    return ForceTracking(
        correlation=_compute_correlation(desired_n, measured_n),
        median_error=float(np.median(np.abs(measured_n - desired_n) / desired_n)),
        no_contact_fraction=float(np.mean(measured_n < MIN_CONTACT_FORCE_N)),
    )


def _compute_correlation(desired_n: Floats, measured_n: Floats) -> float | None:
    """Return Pearson's correlation; None if there are too few pairs, or if all forces are equal."""
    if len(desired_n) < MIN_PAIRS or desired_n.std() < 1e-9 or measured_n.std() < 1e-9:
        return None
    return float(np.corrcoef(desired_n, measured_n)[0, 1])
