"""Which drives of a bus may be driven: none that has stopped by itself, until the operator resets the fault. Pure.

A drive stops by itself when its watchdog expires, when it finds an error, or when it restarts. Two things must not
happen to such a stop: a command clears it before the driver has read it, or a later setpoint enables the drive again.
"""

from collections.abc import Callable, Iterable

from snakesim_drivers.kit.findings import FaultFinding

NO_DRIVES: frozenset[int] = frozenset()
# Control cycles after a reset in which drives may still report errors from before it.
RESET_GRACE_CYCLES = 5


class DriveGuard:
    """The drives of one bus, by their indices on it."""

    def __init__(
        self, clock_ns: Callable[[], int], *, watchdog_timeout_ns: int, reset_grace_period_ns: int
    ) -> None:
        """Start tracking which drives of one bus have stopped by themselves; at first no drive is enabled.

        Args:
            clock_ns: Function that returns the driver's time in ns.
            watchdog_timeout_ns: Duration of a pause of the driver after which watchdogs of drives may have expired.
            reset_grace_period_ns: Duration after a reset in which drives may still report errors from before it.
        """
        self._clock_ns = clock_ns
        self._max_pause_ns = watchdog_timeout_ns
        self._reset_grace_period_ns = reset_grace_period_ns
        # Times of the driver.
        # When the driver last used the bus; None before that.
        self._last_active_ns: int | None = None
        # Time of the operator's last reset; None before that.
        self._last_reset_ns: int | None = None
        # Whether the driver paused too long since it last read the states of the drives.
        self._was_paused = False
        # Drives, by their indices on the bus.
        # Drives that got setpoints in the newest command.
        self._enabled_drives: frozenset[int] = NO_DRIVES
        # Drives that stopped by themselves since the last reset.
        self._self_stopped_drives: frozenset[int] = NO_DRIVES
        # Whether the bus has switched its drives off by itself since the last reset, for lack of setpoints.
        self._were_drives_released = False

    # --- pauses of the driver --------------------------------------------------------------------------------

    def mark_active(self) -> None:
        """Note that the driver runs now. A pause before this call is remembered until `mark_states_read`."""
        now_ns = self._clock_ns()
        if self._last_active_ns is not None and now_ns - self._last_active_ns > self._max_pause_ns:
            self._was_paused = True
        self._last_active_ns = now_ns

    @property
    def was_paused(self) -> bool:
        """Whether watchdogs of drives may have expired since their states were read last."""
        return self._was_paused

    def mark_states_read(self) -> None:
        """Note that the driver has requested the state of every drive after a pause."""
        self._was_paused = False

    # --- which drives are driven -----------------------------------------------------------------------------

    def select_drives_to_enable(
        self, requested: frozenset[int], *, may_enable: bool
    ) -> frozenset[int]:
        """Return those of the requested drives that get setpoints now, and remember them as enabled.

        Args:
            requested: Indices of the drives that should follow setpoints.
            may_enable: True if the robot is armed. Otherwise no drive is enabled that was off before.

        Returns:
            Indices without the drives that have stopped by themselves or were released since the last reset.
        """
        if self._were_drives_released:
            self._enabled_drives = NO_DRIVES
        elif may_enable:
            self._enabled_drives = requested - self._self_stopped_drives
        else:
            self._enabled_drives &= requested - self._self_stopped_drives
        return self._enabled_drives

    def note_drives_released(self) -> bool:
        """Note that the bus switches its drives off by itself, for lack of setpoints.

        If any drive was enabled, no drive is enabled again before a reset.

        Returns:
            Whether any drive was enabled until now.
        """
        was_enabled = bool(self._enabled_drives)
        self._enabled_drives = NO_DRIVES
        self._were_drives_released |= was_enabled
        return was_enabled

    def note_findings(self, findings: Iterable[FaultFinding]) -> None:
        """Note what is wrong with the drives. An enabled drive with a finding is not enabled again before a reset."""
        if (
            self._last_reset_ns is not None
            and self._clock_ns() - self._last_reset_ns <= self._reset_grace_period_ns
        ):
            return
        drives_with_findings = frozenset(
            finding.joint for finding in findings if finding.joint is not None
        )
        self._self_stopped_drives |= drives_with_findings & self._enabled_drives

    def reset(self, drives: frozenset[int]) -> None:
        """Note that the operator has reset the fault: these drives may be enabled at the next arming."""
        self._self_stopped_drives -= drives
        self._were_drives_released = False
        self._last_reset_ns = self._clock_ns()
