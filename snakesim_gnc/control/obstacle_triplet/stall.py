"""Detects standing still although pushing, and its cause. Pure except for its own state."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_gnc.control.contact_forces import NetContactForce, explain_standstill


@dataclass(frozen=True)
class Stall:
    """Why the snake stands."""

    jammed: bool  # obstacles hold it back, by what its contacts measure
    lets_go: bool  # whatever it is, another triplet may do better
    why: str


class StallWatch:
    """Compares progress with propulsion over a sliding window."""

    def __init__(self, *, stall_m: float, stall_s: float, propulsion_n: float) -> None:
        self._stall_m = stall_m
        self._stall_s = stall_s
        self._min_n = propulsion_n / 2
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
        return abs(tail_s_m - recent[0][1]) < self._stall_m and self._pushed_n > self._min_n * len(recent)


def explain(
    *,
    wanted_n: float,
    force_n: float,
    carried: NetContactForce | None,
    push_points: Sequence[str],
    weight_n: float,
    saturated: str | None,
    swung: str | None,
    jam_force_n: float,
    drag_ratio: float,
) -> Stall:
    """The cause of a stall, as far as what is measured shows it.

    wanted_n: propulsion from the speed alone; force_n: what is commanded of it. carried: along the path, by contacts;
    None when no sensor tells. push_points: obstacles of the triplet. saturated, swung: name of the propulsion joint if
    it is at its torque limit, or has swung out so far that the propulsion was reduced.
    """
    strongest_n = None if carried is None else carried.strongest_n
    strained = saturated is not None or swung is not None or wanted_n > drag_ratio * weight_n
    lets_go = strongest_n != 0.0 and (strained or (strongest_n is not None and strongest_n > jam_force_n))
    jammed, why = explain_standstill(force_n, carried, push_points)
    if swung is not None:
        why += f"; {swung} has swung out and leaves no more of the {wanted_n:.1f} N wanted"
    elif saturated is not None:
        why += f"; {saturated} at its limit of torque gives no more of the {wanted_n:.1f} N wanted"
    elif carried is not None and not jammed and strongest_n != 0.0:
        why += "; raise propulsion_n"
    return Stall(jammed, lets_go, why)
