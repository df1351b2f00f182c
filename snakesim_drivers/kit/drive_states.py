"""Compares what each drive should do with what it reports, and decides which commands a driver sends again. Pure.

For drives on any bus that report whether they are on: a driver type passes these reports to `record_report`, and sends
the commands that `update_commands` returns.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from snakesim_drivers.kit.findings import FaultFinding

# Enable, disable, or the drive's own emergency stop.
DriveCommand = Literal["follow", "idle", "stop"]

# Report periods after a command, from which on reports surely show its effect.
MIN_RESPONSE_REPORT_PERIODS = 1.5
# Report periods after a command, within which a drive has to be on, if its type states no time.
MAX_ENABLE_REPORT_PERIODS = 5


@dataclass
class DriveState:
    """One drive: whether it should be on, and what it reported last."""

    label: str  # for messages, such as "joint_2 (node 2 on can0)"

    # Commanded.
    should_be_enabled: bool = False
    command_changed_ns: int = -1  # driver time when `should_be_enabled` last changed; -1: never
    was_enabled: bool = False  # whether the drive has been on since it should be
    is_emergency_stopped: bool = False  # by the driver, since the last reset

    # Reported.
    enabled: bool | None = None  # whether it is on; None: not reported yet
    state: str = ""  # in the driver type's words
    last_report_ns: int = -1  # driver time of the last report; -1: none yet
    errors: str = ""  # in words; empty: none
    safe_torque_off: bool = False  # whether the input of this name keeps the motor off


class DriveStates:
    """The states of several drives, from tail to head."""

    def __init__(
        self,
        labels: Sequence[str],
        report_period_ns: int,
        clock_ns: Callable[[], int],
        max_enable_s: float | None = None,
    ) -> None:
        """Create the states of drives that should be off and have not reported anything.

        Args:
            labels: Names of the drives for messages, from tail to head.
            report_period_ns: Time from one report of a drive to the next.
            clock_ns: Function that returns the driver's time in ns.
            max_enable_s: Time within which a drive switches on, over all its states. None: five report periods.
        """
        self.drives = [DriveState(label) for label in labels]
        self._min_response_delay_ns = round(MIN_RESPONSE_REPORT_PERIODS * report_period_ns)
        if max_enable_s is None:
            self._max_enable_duration_ns = MAX_ENABLE_REPORT_PERIODS * report_period_ns
        else:
            self._max_enable_duration_ns = round(max_enable_s * 1e9)
        self._clock_ns = clock_ns

    def record_report(self, i: int, *, enabled: bool, state: str) -> None:
        """Store whether a drive reports that it is on, and its state in words.

        Args:
            i: Index of the drive.
            enabled: Whether the drive reports that it is on.
            state: State of the drive in the driver type's words, for messages.
        """
        drive = self.drives[i]
        drive.enabled = enabled
        drive.state = state
        drive.last_report_ns = self._clock_ns()
        if drive.should_be_enabled and enabled and self._has_reported_since_command(drive):
            drive.was_enabled = True

    def update_commands(
        self, enabled_drives: frozenset[int], *, emergency: bool
    ) -> list[tuple[int, DriveCommand]]:
        """Store which drives should be on, and return the commands to send now.

        There is a command for each drive whose target state has changed, and again for each drive that reports that it
        has not reached its target state. A change of `emergency` alone sends nothing: drives that are off stay off.

        Args:
            enabled_drives: Indices of the drives that should follow setpoints.
            emergency: Whether all other drives are stopped by their own emergency stop instead of disabled.

        Returns:
            Pairs of a drive's index and its command: "follow" (enable), "idle" (disable) or "stop" (emergency stop).
        """
        commands: list[tuple[int, DriveCommand]] = []
        for i, drive in enumerate(self.drives):
            should_be_enabled = i in enabled_drives
            if drive.should_be_enabled != should_be_enabled:
                drive.should_be_enabled = should_be_enabled
                drive.was_enabled = False
                drive.command_changed_ns = self._clock_ns()
            elif not self._needs_retry(drive):
                continue
            command = _choose_command(should_be_enabled=should_be_enabled, emergency=emergency)
            if emergency and not should_be_enabled:
                drive.is_emergency_stopped = True
            commands.append((i, command))
        return commands

    def get_enabled_drives(self) -> frozenset[int]:
        """Return the indices of the drives that should be on and report that they are."""
        return frozenset(
            i for i, drive in enumerate(self.drives) if drive.should_be_enabled and drive.enabled
        )

    def reset_errors(self, drives: Iterable[int]) -> None:
        """Forget the errors of these drives, because the driver has just cleared them."""
        for i in drives:
            self.drives[i].errors = ""
            self.drives[i].is_emergency_stopped = False

    def list_findings(self) -> list[FaultFinding]:
        """List at most one finding for each drive, for the first of these that is true.

        Its safe-torque-off input keeps the motor off; it reports errors; it is off although it should be on, and had
        time to switch on.
        """
        findings: list[FaultFinding] = []
        for i, drive in enumerate(self.drives):
            if drive.safe_torque_off:
                cause = f"{drive.label}: its safe-torque-off input is active; release it, then reset and arm"
                findings.append(FaultFinding("safe_torque_off", cause, joint=i))
            elif drive.errors:
                findings.append(
                    FaultFinding(
                        "drive_fault",
                        f"{drive.label} reports {drive.errors}",
                        joint=i,
                        affects_only_joint=True,
                    )
                )
            elif drive.should_be_enabled and self._had_time_to_enable(drive) and not drive.enabled:
                cause = (
                    f"{drive.label} does not follow: it is {drive.state or 'in an unknown state'}"
                )
                findings.append(
                    FaultFinding(
                        "drive_not_armed", cause, joint=i, affects_only_joint=drive.was_enabled
                    )
                )
        return findings

    def _needs_retry(self, drive: DriveState) -> bool:
        """Return whether a drive has reported that it did not execute its last command.

        A drive that was on, or has had time to switch on, is not enabled a second time: it has stopped by itself, and
        that is a finding.
        """
        if drive.should_be_enabled and self._had_time_to_enable(drive):
            return False
        return self._has_reported_since_command(drive) and drive.enabled not in (
            None,
            drive.should_be_enabled,
        )

    def _has_reported_since_command(self, drive: DriveState) -> bool:
        """Return whether the last report is so late that it shows the effect of the last command."""
        return drive.last_report_ns - drive.command_changed_ns > self._min_response_delay_ns

    def _had_time_to_enable(self, drive: DriveState) -> bool:
        """Return whether a drive was on since the last command, or has had enough time to switch on."""
        return (
            drive.was_enabled
            or self._clock_ns() - drive.command_changed_ns > self._max_enable_duration_ns
        )


def _choose_command(*, should_be_enabled: bool, emergency: bool) -> DriveCommand:
    """Return the command that brings a drive into its target state."""
    if should_be_enabled:
        return "follow"
    if emergency:
        return "stop"
    return "idle"
