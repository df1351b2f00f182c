"""Detects standing still although pushing, and its cause. Pure except for its own state."""

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class Stall:
    """Why the snake stands."""

    jammed: bool  # False: the propulsion is simply too little
    why: str


class StallWatch:
    """Compares progress with propulsion over a sliding window."""

    def __init__(self, *, stall_m: float, stall_s: float, propulsion_n: float) -> None:
        self._stall_m = stall_m
        self._stall_s = stall_s
        self._least_n = propulsion_n / 2
        self._recent: deque[tuple[float, float, float]] = deque()
        self._pushed_n = 0.0  # sum over the window

    def forget(self) -> None:
        """Start a new window."""
        self._recent.clear()
        self._pushed_n = 0.0

    def stands(self, time_s: float, tail_s_m: float, force_n: float) -> bool:
        """Whether the body has stood still through a whole window while pushing; call while propelling."""
        recent = self._recent
        recent.append((time_s, tail_s_m, force_n))
        self._pushed_n += force_n
        while recent[-1][0] - recent[0][0] > self._stall_s + 1e-9:
            self._pushed_n -= recent.popleft()[2]
        if time_s - recent[0][0] < self._stall_s - 1e-9:
            return False
        return abs(tail_s_m - recent[0][1]) < self._stall_m and self._pushed_n > self._least_n * len(recent)


def explain(
    *,
    force_n: float,
    contact_force_n: float | None,
    weight_n: float,
    saturated: str | None,
    swung: str | None,
    jam_force_n: float,
    drag_share: float,
) -> Stall:
    """The cause of a stall, as far as what is measured shows it.

    force_n: propulsion from the speed alone. contact_force_n: the strongest measured; 0 when nothing touches the body,
    None when no sensor tells. saturated, swung: name of the propulsion joint if it is at its torque limit, or has swung
    out so far that the propulsion was reduced.
    """
    pushing = f"standing still with {force_n:.1f} N of propulsion"
    if contact_force_n == 0.0:
        return Stall(False, f"{pushing}, and no obstacle touches the body, so there is nothing to push off")
    if contact_force_n is not None and contact_force_n > jam_force_n:
        return Stall(True, f"jammed: {pushing} and a contact force of {contact_force_n:.0f} N")
    if saturated is not None:
        return Stall(True, f"jammed: {pushing} and {saturated} at its limit of torque")
    if force_n > drag_share * weight_n:
        share = force_n / weight_n
        return Stall(True, f"jammed: {pushing}, {share:.2f} of the weight; no sliding on the ground takes so much")
    if swung is not None:
        return Stall(True, f"jammed: {pushing}; {swung} swings out instead of moving the body")
    return Stall(
        False, f"{pushing}: too little against the friction of the ground, or what is in the way; raise propulsion_n"
    )
