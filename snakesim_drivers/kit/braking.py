"""How long drives brake after a fault: until their joint is at rest, at most for their watchdog's time. Pure.

Joint modules do so by themselves (state STOPPING of the bus protocol). Drives of every other type would brake for as
long as a driver commands it, so the driver ends it by the same rule: docs/safety.md, "After a stop".
"""

from collections.abc import Sequence

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Mode

AT_REST_RAD_S = 0.05  # as joint modules have it


class Braking:
    """The joints that still brake in a fault, by their numbers in the robot."""

    def __init__(self, limits_ns: Sequence[int], *, holds: bool) -> None:
        """limits_ns: of every joint; holds: the stop mode is `hold`, which has no end."""
        self._limits_ns = limits_ns
        self._holds = holds
        self._began_ns: int | None = None
        self._done: set[int] = set()  # joints, in this fault

    def reset(self) -> None:
        """Note that the robot is not in a fault: the next one begins anew."""
        self._began_ns = None
        self._done.clear()

    def select_braking_joints(
        self, following: frozenset[int], modes: Sequence[Mode], velocity_rad_s: Floats, now_ns: int
    ) -> frozenset[int]:
        """Return those of the following joints that go on in this period of a fault.

        modes: of the stop mode's setpoints, where a passive joint is let go.
        """
        if self._began_ns is None:
            self._began_ns = now_ns
        braked_ns = now_ns - self._began_ns
        for i in following:
            speed_rad_s = abs(float(velocity_rad_s[i]))
            if modes[i] == Mode.PASSIVE or self._is_over(i, speed_rad_s, braked_ns):
                self._done.add(i)
        return following - self._done

    def _is_over(self, i: int, speed_rad_s: float, braked_ns: int) -> bool:
        if self._holds:
            return False
        return speed_rad_s < AT_REST_RAD_S or braked_ns >= self._limits_ns[i]
