"""How long drives brake after a fault: until their joint is at rest, at most for their watchdog's time. Pure.

Joint modules do so by themselves (state STOPPING of the bus protocol). Drives of every other type would brake for as
long as a driver commands it, so the driver ends it by the same rule: docs/concepts/stop-modes.md.
"""

from collections.abc import Sequence

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import JointMode

AT_REST_SPEED_RAD_S = 0.05  # the limit that joint modules have


class BrakingJoints:
    """The joints that still brake in a fault, by their indices in the robot."""

    def __init__(self, max_braking_durations_ns: Sequence[int], *, is_hold_mode: bool) -> None:
        """Create the braking state of all joints, before any fault.

        Args:
            max_braking_durations_ns: Maximum braking time of every joint, from tail to head.
            is_hold_mode: True if the stop mode is `hold`, in which joints are held until the operator's reset.
        """
        self._max_braking_durations_ns = max_braking_durations_ns
        self._is_hold_mode = is_hold_mode
        # Driver time of the first cycle of the current fault; None without a fault.
        self._fault_start_ns: int | None = None
        # Joints that have finished braking in the current fault.
        self._stopped_joints: set[int] = set()

    def reset(self) -> None:
        """Forget the braking of the last fault, because the robot is not in a fault now."""
        self._fault_start_ns = None
        self._stopped_joints.clear()

    def select_braking_joints(
        self,
        driven_joints: frozenset[int],
        modes: Sequence[JointMode],
        velocity_rad_s: Floats,
        now_ns: int,
    ) -> frozenset[int]:
        """Return the joints that continue to brake in this control cycle of a fault, and remember those that are done.

        A joint is done when it is slow enough, its braking time is over, or its setpoint is passive. It does not brake
        again in the same fault. Call it once in each control cycle of a fault.

        Args:
            driven_joints: Indices of the joints that got setpoints in the last cycle.
            modes: Mode of every joint's setpoint in the stop mode, from tail to head. A passive joint does not brake.
            velocity_rad_s: Measured joint velocities, (n_joints,).
            now_ns: Current time of the driver.

        Returns:
            Indices of the joints that still need setpoints.
        """
        if self._fault_start_ns is None:
            self._fault_start_ns = now_ns
        braking_duration_ns = now_ns - self._fault_start_ns
        for i in driven_joints:
            speed_rad_s = abs(float(velocity_rad_s[i]))
            if modes[i] == JointMode.PASSIVE or self._has_stopped_braking(
                i, speed_rad_s, braking_duration_ns
            ):
                self._stopped_joints.add(i)
        return driven_joints - self._stopped_joints

    def _has_stopped_braking(self, i: int, speed_rad_s: float, braking_duration_ns: int) -> bool:
        if self._is_hold_mode:
            return False
        return (
            speed_rad_s < AT_REST_SPEED_RAD_S
            or braking_duration_ns >= self._max_braking_durations_ns[i]
        )
