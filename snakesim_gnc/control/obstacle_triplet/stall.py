"""Detects that the body is stationary although it pushes, and explains why."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_gnc.control.contact_forces import NetContactForce, explain_standstill

# Of `propulsion_n`; with less as a mean over the window, the body does not really push.
MIN_PUSH_RATIO = 0.5
TIME_TOLERANCE_S = 1e-9  # rounding of sums of ticks


@dataclass(frozen=True)
class StallReason:
    """Why the body is stationary."""

    is_jammed: bool  # obstacles hold the body back, by its measured contact forces
    should_release_triplet: bool  # another triplet may do better
    reason: str


class StallDetector:
    """Compares progress with propulsion over a sliding window."""

    def __init__(self, *, stall_m: float, stall_s: float, propulsion_n: float) -> None:
        """Prepare to detect a stall, with an empty window.

        Args:
            stall_m: Progress within the window below which the body is stationary.
            stall_s: Duration of the window.
            propulsion_n: Maximum propulsion force; the body pushes if the mean force is above MIN_PUSH_RATIO of it.
        """
        self._min_progress_m = stall_m
        self._window_s = stall_s
        self._min_mean_force_n = MIN_PUSH_RATIO * propulsion_n
        # Time in s, arc length in m, force in N.
        self._recent_samples: deque[tuple[float, float, float]] = deque()
        self._force_sum_n = 0.0  # over the window

    def reset(self) -> None:
        """Start a new window."""
        self._recent_samples.clear()
        self._force_sum_n = 0.0

    def has_stalled(self, time_s: float, tail_s_m: float, force_n: float) -> bool:
        """Add the progress and the force of this tick, and return whether the body has stalled.

        The body has stalled if it was stationary through a whole window while it was pushing. Call it in every tick in
        which the body pushes.

        Args:
            time_s: Time of the tick.
            tail_s_m: Arc length of the tail end on the path.
            force_n: Desired propulsion force.
        """
        samples = self._recent_samples
        samples.append((time_s, tail_s_m, force_n))
        self._force_sum_n += force_n
        while samples[-1][0] - samples[0][0] > self._window_s + TIME_TOLERANCE_S:
            _, _, expired_n = samples.popleft()
            self._force_sum_n -= expired_n
        first_s, first_s_m, _ = samples[0]
        if time_s - first_s < self._window_s - TIME_TOLERANCE_S:
            return False
        return abs(
            tail_s_m - first_s_m
        ) < self._min_progress_m and self._force_sum_n > self._min_mean_force_n * len(samples)


def explain_stall(
    *,
    desired_force_n: float,
    force_n: float,
    net_force: NetContactForce | None,
    push_points: Sequence[str],
    weight_n: float,
    saturated_joint: str | None,
    swung_out_joint: str | None,
    jam_force_n: float,
    drag_ratio: float,
) -> StallReason:
    """Explain why the body does not move although it pushes, as far as the measurements show the cause.

    Args:
        desired_force_n: Propulsion force that follows from the speed alone, before any limit.
        force_n: Commanded propulsion force.
        net_force: Measured contact forces along the path; None without a contact sensor.
        push_points: Names of the triplet's obstacles.
        weight_n: Weight of the robot.
        saturated_joint: Name of the propulsion joint if it is at its torque limit; None if it is not.
        swung_out_joint: Name of the propulsion joint if it has swung out so far that the propulsion was reduced; else
            None.
        jam_force_n: Contact force above which the contacts are strained.
        drag_ratio: Ratio of propulsion to weight above which the joint is strained.

    Returns:
        Whether obstacles jam the body, whether to release the triplet, and the reason as text.
    """
    may_touch_obstacles = net_force is None or net_force.max_contact_n != 0.0
    is_joint_strained = (
        saturated_joint is not None
        or swung_out_joint is not None
        or desired_force_n > drag_ratio * weight_n
    )
    are_contacts_strained = net_force is not None and net_force.max_contact_n > jam_force_n
    jammed, reason = explain_standstill(force_n, net_force, push_points)
    if swung_out_joint is not None:
        reason += f"; {swung_out_joint} has swung out and leaves no more of the {desired_force_n:.1f} N desired"
    elif saturated_joint is not None:
        reason += f"; {saturated_joint} at its limit of torque gives no more of the {desired_force_n:.1f} N desired"
    elif net_force is not None and not jammed and may_touch_obstacles:
        reason += "; raise propulsion_n"
    return StallReason(
        is_jammed=jammed,
        should_release_triplet=may_touch_obstacles and (is_joint_strained or are_contacts_strained),
        reason=reason,
    )
