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
from snakesim_hal.wire.messages import Mode


class BrakePlan(NamedTuple):
    """What drives and their brakes are to do in this cycle."""

    command: BusCommand  # with the drives that hold their position while a brake opens or closes
    released: frozenset[int]  # drives whose brake is to be open


class HoldingBrakes:
    """The brakes of all drives on one bus, by their indices on it. All are closed at first."""

    def __init__(self, count: int, *, release_s: float, engage_s: float, clock_ns: Callable[[], int]) -> None:
        """Begin with closed brakes.

        Args:
            count: Number of drives.
            release_s: Time from the command until a brake is open.
            engage_s: Time from the command until a brake holds.
            clock_ns: The driver's time.
        """
        self._release_ns = round(release_s * 1e9)
        self._engage_ns = round(engage_s * 1e9)
        self._clock_ns = clock_ns
        self._released_ns: list[int | None] = [None] * count  # when a brake was told to open; None: it is closed
        self._engaged_ns: list[int | None] = [None] * count  # when it was told to close; None: long ago
        self._hold_rad = [0.0] * count
        self._hold_limit_nm = [0.0] * count

    def plan(self, command: BusCommand, enabled: Collection[int], angle_rad: Floats) -> BrakePlan:
        """Return the command with holding drives, and the brakes that are to be open.

        Args:
            command: What the drives are to do if they had no brakes.
            enabled: The drives that report that they are on.
            angle_rad: (n_drives,) measured angles of the shafts.
        """
        now_ns = self._clock_ns()
        holding: set[int] = set()
        for i, angle in enumerate(angle_rad.tolist()):
            if i in command.following:
                self._open(i, now_ns, is_enabled=i in enabled, angle_rad=angle, limit_nm=float(command.limits_nm[i]))
                if self._is_opening(i, now_ns):
                    holding.add(i)
            else:
                self._close(i, now_ns, angle_rad=angle)
                if self._is_closing(i, now_ns) and i in enabled and not command.emergency:
                    holding.add(i)
        released = frozenset(i for i, released_ns in enumerate(self._released_ns) if released_ns is not None)
        return BrakePlan(self._hold(command, holding), released)

    def _open(self, i: int, now_ns: int, *, is_enabled: bool, angle_rad: float, limit_nm: float) -> None:
        self._engaged_ns[i] = None
        self._hold_limit_nm[i] = limit_nm
        if self._released_ns[i] is None:
            self._hold_rad[i] = angle_rad
            if is_enabled:
                self._released_ns[i] = now_ns

    def _close(self, i: int, now_ns: int, *, angle_rad: float) -> None:
        if self._released_ns[i] is not None:
            self._released_ns[i] = None
            self._engaged_ns[i] = now_ns
            self._hold_rad[i] = angle_rad

    def _is_opening(self, i: int, now_ns: int) -> bool:
        released_ns = self._released_ns[i]
        return released_ns is None or now_ns - released_ns < self._release_ns

    def _is_closing(self, i: int, now_ns: int) -> bool:
        engaged_ns = self._engaged_ns[i]
        return engaged_ns is not None and now_ns - engaged_ns < self._engage_ns

    def _hold(self, command: BusCommand, holding: set[int]) -> BusCommand:
        """Return the command with these drives at their angle, in position mode."""
        modes = list(command.modes)
        targets = command.targets.copy()
        limits_nm = command.limits_nm.copy()
        for i in holding:
            modes[i] = Mode.POSITION
            targets[i] = self._hold_rad[i]
            limits_nm[i] = self._hold_limit_nm[i]
        return command._replace(
            following=command.following | holding, modes=modes, targets=targets, limits_nm=limits_nm
        )
