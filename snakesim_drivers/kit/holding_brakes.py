"""Brakes that hold a joint without torque: when they open and close, and when torque is on. Pure.

A brake opens only after its drive is enabled, and torque is held until it has closed again. Otherwise a joint that
carries a load would drop. Keep `engage_s` shorter than the watchdog of the drive: then torque is held long enough after
the last setpoint, too, when the driver process ends and the drive closes the brake by itself.

An emergency stop switches torque off at once, and closes the brake at the same time: it must not wait for a timer.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

from snakesim_drivers.kit.drives import BusCommand
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import JointMode


class BrakePlan(NamedTuple):
    """What drives and their brakes are to do in this cycle."""

    command: BusCommand  # with the drives that hold their position while a brake opens or closes
    released: frozenset[int]  # drives whose brake is to be open


class HoldingBrakes:
    """The brakes of all drives on one bus, by their indices on it. All are closed at first."""

    def __init__(
        self, count: int, *, release_s: float, engage_s: float, clock_ns: Callable[[], int]
    ) -> None:
        """Create the brakes of a bus, all closed.

        Args:
            count: Number of drives.
            release_s: Duration from the command until a brake is open.
            engage_s: Duration from the command until a brake holds.
            clock_ns: Function that returns the driver's time in ns.
        """
        self._release_duration_ns = round(release_s * 1e9)
        self._engage_duration_ns = round(engage_s * 1e9)
        self._clock_ns = clock_ns
        # When each brake was commanded to open; None: it is closed.
        self._release_start_ns: list[int | None] = [None] * count
        # When each brake was commanded to close; None: it opens or is closed.
        self._engage_start_ns: list[int | None] = [None] * count
        self._hold_angles_rad = [0.0] * count
        self._hold_torque_limits_nm = [0.0] * count

    def update_brakes(
        self, command: BusCommand, enabled_drives: Collection[int], angles_rad: Floats
    ) -> BrakePlan:
        """Start to release or engage brakes for a command, and let drives hold their position until that is done.

        Call this once in every cycle. The rules are:

        * A drive that the command enables holds its position until its brake is released.
        * A drive that the command switches off stays enabled, and holds its position, until its brake is engaged.
        * After an emergency stop, a drive is switched off at once.

        Args:
            command: The command as if there were no brakes.
            enabled_drives: Indices of the drives that report that they are enabled.
            angles_rad: Measured angles of the shafts, (n_drives,).

        Returns:
            The command to send, and the drives whose brake is to be released, or is being released.
        """
        now_ns = self._clock_ns()
        holding_drives: set[int] = set()
        for i, angle in enumerate(angles_rad.tolist()):
            if i in command.enabled_drives:
                self._start_brake_release(
                    i,
                    now_ns,
                    is_enabled=i in enabled_drives,
                    angle_rad=angle,
                    limit_nm=float(command.limits_nm[i]),
                )
                if self._is_brake_releasing(i, now_ns):
                    holding_drives.add(i)
            else:
                self._start_brake_engagement(i, now_ns, angle_rad=angle)
                if (
                    self._is_brake_engaging(i, now_ns)
                    and i in enabled_drives
                    and not command.emergency
                ):
                    holding_drives.add(i)
        drives_to_release = frozenset(
            i
            for i, release_start_ns in enumerate(self._release_start_ns)
            if release_start_ns is not None
        )
        return BrakePlan(
            self._replace_with_hold_setpoints(command, holding_drives), drives_to_release
        )

    def _start_brake_release(
        self, i: int, now_ns: int, *, is_enabled: bool, angle_rad: float, limit_nm: float
    ) -> None:
        self._engage_start_ns[i] = None
        self._hold_torque_limits_nm[i] = limit_nm
        if self._release_start_ns[i] is None:
            self._hold_angles_rad[i] = angle_rad
            if is_enabled:
                self._release_start_ns[i] = now_ns

    def _start_brake_engagement(self, i: int, now_ns: int, *, angle_rad: float) -> None:
        if self._release_start_ns[i] is not None:
            self._release_start_ns[i] = None
            self._engage_start_ns[i] = now_ns
            self._hold_angles_rad[i] = angle_rad

    def _is_brake_releasing(self, i: int, now_ns: int) -> bool:
        release_start_ns = self._release_start_ns[i]
        return release_start_ns is None or now_ns - release_start_ns < self._release_duration_ns

    def _is_brake_engaging(self, i: int, now_ns: int) -> bool:
        engage_start_ns = self._engage_start_ns[i]
        return engage_start_ns is not None and now_ns - engage_start_ns < self._engage_duration_ns

    def _replace_with_hold_setpoints(
        self, command: BusCommand, holding_drives: set[int]
    ) -> BusCommand:
        """Return the command with these drives enabled, in position mode at the angle that they have to hold."""
        modes = list(command.modes)
        targets = command.targets.copy()
        limits_nm = command.limits_nm.copy()
        for i in holding_drives:
            modes[i] = JointMode.POSITION
            targets[i] = self._hold_angles_rad[i]
            limits_nm[i] = self._hold_torque_limits_nm[i]
        return command._replace(
            enabled_drives=command.enabled_drives | holding_drives,
            modes=modes,
            targets=targets,
            limits_nm=limits_nm,
        )
