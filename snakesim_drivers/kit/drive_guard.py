"""Which drives of a bus may be driven: none that has stopped by itself, until the operator resets the fault. Pure.

A drive stops by itself when its watchdog expires, when it finds an error, or when it restarts. Two things must not
happen to such a stop: a command clears it before the driver has read it, or a later setpoint enables the drive again.
"""

from collections.abc import Callable, Iterable

from snakesim_drivers.kit.findings import Finding

NO_DRIVES: frozenset[int] = frozenset()
RESET_GRACE_CYCLES = 5  # control cycles after a reset in which drives may still report errors from before it


class DriveGuard:
    """The drives of one bus, by their indices on it."""

    def __init__(self, clock_ns: Callable[[], int], *, gap_ns: int, grace_ns: int) -> None:
        """Start to guard the drives of one bus, which were just brought up, and none of which is driven.

        Args:
            clock_ns: Returns the driver's time.
            gap_ns: A pause of the driver after which watchdogs of drives may have expired.
            grace_ns: Time after a reset in which drives may still report an error from before it.
        """
        self._clock_ns = clock_ns
        self._gap_ns = gap_ns
        self._grace_ns = grace_ns
        # The driver's own times.
        self._active_ns: int | None = None  # when the driver last used the bus
        self._reset_ns: int | None = None
        self._away = False
        # Drives, until they are released or reset.
        self._driven = NO_DRIVES
        self._stopped = NO_DRIVES
        self._starved = False  # whether the bus has released its drives while the robot was armed

    # --- pauses of the driver --------------------------------------------------------------------------------

    def mark_active(self) -> None:
        """Note that the driver runs now. A pause before it is remembered until `mark_states_read`."""
        now_ns = self._clock_ns()
        if self._active_ns is not None and now_ns - self._active_ns > self._gap_ns:
            self._away = True
        self._active_ns = now_ns

    @property
    def was_away(self) -> bool:
        """Whether watchdogs of drives may have expired since their states were read last."""
        return self._away

    def mark_states_read(self) -> None:
        """Note that the driver requests the state of every drive after the pause."""
        self._away = False

    # --- which drives are driven -----------------------------------------------------------------------------

    def drives_to_command(self, requested: frozenset[int], *, may_enable: bool) -> frozenset[int]:
        """Return those of the requested drives that get setpoints now.

        Args:
            requested: The drives that should follow setpoints.
            may_enable: Whether the robot is armed. Otherwise only drives that are driven already stay driven.
        """
        if self._starved:
            self._driven = NO_DRIVES
        elif may_enable:
            self._driven = requested - self._stopped
        else:
            self._driven &= requested - self._stopped
        return self._driven

    def release_drives(self) -> bool:
        """Note that the bus switches its drives off by itself. No drive is driven again before a reset.

        Returns:
            Whether any drive was driven until now.
        """
        had_driven = bool(self._driven)
        self._driven = NO_DRIVES
        self._starved |= had_driven
        return had_driven

    def note_findings(self, findings: Iterable[Finding]) -> None:
        """Note what the driver reports of its drives. A driven drive with a finding is not driven before a reset."""
        if self._reset_ns is not None and self._clock_ns() - self._reset_ns <= self._grace_ns:
            return
        reported = frozenset(finding.joint for finding in findings if finding.joint is not None)
        self._stopped |= reported & self._driven

    def reset(self, drives: frozenset[int]) -> None:
        """Note that the operator has reset the fault: these drives may be driven at the next arming."""
        self._stopped -= drives
        self._starved = False
        self._reset_ns = self._clock_ns()
