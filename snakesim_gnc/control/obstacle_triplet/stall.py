"""Detects that the body is stationary although it pushes, and explains why."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_gnc.control.contact_forces import NetContactForce, explain_standstill

MIN_PUSH_RATIO = 0.5  # of `propulsion_n`; with less as a mean over the window, the body does not really push
TIME_TOLERANCE_S = 1e-9  # rounding of sums of ticks


@dataclass(frozen=True)
class Stall:
    """Why the body is stationary."""

    jammed: bool  # obstacles hold the body back, by its measured contact forces
    release_triplet: bool  # another triplet may do better
    reason: str


class StallWatch:
    """Compares progress with propulsion over a sliding window."""

    def __init__(self, *, stall_m: float, stall_s: float, propulsion_n: float) -> None:
        self._stall_m = stall_m
        self._stall_s = stall_s
        self._min_n = MIN_PUSH_RATIO * propulsion_n
        self._recent: deque[tuple[float, float, float]] = deque()  # time in s, arc length in m, force in N
        self._force_sum_n = 0.0  # over the window

    def reset(self) -> None:
        """Start a new window."""
        self._recent.clear()
        self._force_sum_n = 0.0

    def has_stalled(self, time_s: float, tail_s_m: float, force_n: float) -> bool:
        """Return whether the body was stationary through a whole window while pushing; call it in each such tick."""
        recent = self._recent
        recent.append((time_s, tail_s_m, force_n))
        self._force_sum_n += force_n
        while recent[-1][0] - recent[0][0] > self._stall_s + TIME_TOLERANCE_S:
            _, _, expired_n = recent.popleft()
            self._force_sum_n -= expired_n
        first_s, first_s_m, _ = recent[0]
        if time_s - first_s < self._stall_s - TIME_TOLERANCE_S:
            return False
        return abs(tail_s_m - first_s_m) < self._stall_m and self._force_sum_n > self._min_n * len(recent)


def explain(
    *,
    desired_n: float,
    force_n: float,
    net_force: NetContactForce | None,
    push_points: Sequence[str],
    weight_n: float,
    saturated: str | None,
    swung: str | None,
    jam_force_n: float,
    drag_ratio: float,
) -> Stall:
    """Explain why the body does not move although it pushes, as far as the measurements show the cause.

    Args:
        desired_n: propulsion force from the speed alone.
        force_n: commanded propulsion force.
        net_force: measured contact forces along the path; None without a sensor.
        push_points: names of the triplet's obstacles.
        weight_n: weight of the robot.
        saturated: name of the propulsion joint if it is at its torque limit.
        swung: name of the propulsion joint if it has swung out so far that the propulsion was reduced.
        jam_force_n: a larger contact force strains the contacts.
        drag_ratio: ratio of propulsion to weight above which the propulsion strains the joint.

    Returns:
        Whether obstacles jam the body, whether to release the triplet, and the reason as text.
    """
    touches_something = net_force is None or net_force.strongest_n != 0.0
    joint_is_strained = saturated is not None or swung is not None or desired_n > drag_ratio * weight_n
    contacts_are_strained = net_force is not None and net_force.strongest_n > jam_force_n
    jammed, why = explain_standstill(force_n, net_force, push_points)
    if swung is not None:
        why += f"; {swung} has swung out and leaves no more of the {desired_n:.1f} N desired"
    elif saturated is not None:
        why += f"; {saturated} at its limit of torque gives no more of the {desired_n:.1f} N desired"
    elif net_force is not None and not jammed and touches_something:
        why += "; raise propulsion_n"
    return Stall(
        jammed=jammed,
        release_triplet=touches_something and (joint_is_strained or contacts_are_strained),
        reason=why,
    )
