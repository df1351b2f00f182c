"""How long drives brake after a fault: until their joint is at rest, at most for their watchdog's time. Pure.

Joint modules do so by themselves (state STOPPING of the bus protocol). Drives of every other type would brake for as
long as a driver commands it, so the driver ends it by the same rule: docs/concepts/stop-modes.md.
"""

from collections.abc import Sequence

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Mode

AT_REST_RAD_S = 0.05  # the limit that joint modules have


class Braking:
    """The joints that still brake in a fault, by their indices in the robot."""

    def __init__(self, limits_ns: Sequence[int], *, holds: bool) -> None:
        """Begin without a fault.

        Args:
            limits_ns: Maximum braking time of every joint.
            holds: True if the stop mode is `hold`, which has no end.
        """
        self._limits_ns = limits_ns
        self._holds = holds
        self._start_ns: int | None = None  # of the present fault
        self._finished: set[int] = set()  # joints that have braked in it

    def reset(self) -> None:
        """Note that the robot is not in a fault, so that the next fault starts from the beginning."""
        self._start_ns = None
        self._finished.clear()

    def select_braking_joints(
        self, following: frozenset[int], modes: Sequence[Mode], velocity_rad_s: Floats, now_ns: int
    ) -> frozenset[int]:
        """Return those of the following joints that continue to brake in this control cycle of a fault.

        A joint stops braking when it is slow enough or its time is over, and does not begin again.

        Args:
            following: Joints that have got setpoints until now.
            modes: Mode of every joint's setpoint in the stop mode. A passive joint does not brake.
            velocity_rad_s: (n_joints,) measured velocities.
            now_ns: The driver's time.
        """
        if self._start_ns is None:
            self._start_ns = now_ns
        duration_ns = now_ns - self._start_ns
        for i in following:
            speed_rad_s = abs(float(velocity_rad_s[i]))
            if modes[i] == Mode.PASSIVE or self._is_over(i, speed_rad_s, duration_ns):
                self._finished.add(i)
        return following - self._finished

    def _is_over(self, i: int, speed_rad_s: float, duration_ns: int) -> bool:
        if self._holds:
            return False
        return speed_rad_s < AT_REST_RAD_S or duration_ns >= self._limits_ns[i]
