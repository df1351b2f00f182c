"""Compares what each drive should do with what it reports, and decides which commands a driver sends again. Pure.

For drives on any bus that report whether they are on: a driver type passes these reports to `note_report`, and sends
the commands that `next_commands` returns.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from snakesim_drivers.kit.findings import Finding

DriveCommand = Literal["follow", "idle", "stop"]  # stop: the drive's own emergency stop

MIN_REPLY_REPORTS = 1.5  # report periods after a command, before a report surely is about the time after it
MAX_FOLLOW_REPORTS = 5  # report periods after a command, in which a drive has to follow


@dataclass
class DriveState:
    """One drive: what it should do, and what it reported last."""

    label: str  # for messages, such as "joint_2 (node 2 on can0)"

    # Commanded.
    should_follow: bool = False
    commanded_ns: int = -1  # when that changed
    has_followed: bool = False  # since then
    emergency_stopped: bool = False  # by the driver, since the last reset

    # Reported.
    enabled: bool | None = None  # None: not reported yet
    state: str = ""  # in the driver type's words
    reported_ns: int = -1
    errors: str = ""  # in words; empty: none
    safe_torque_off: bool = False  # whether the input of this name keeps the motor off


class DriveStates:
    """The states of several drives, from tail to head."""

    def __init__(self, labels: Sequence[str], report_period_ns: int, clock_ns: Callable[[], int]) -> None:
        """Begin with drives that should be idle and have not reported anything.

        Args:
            labels: Names of the drives for messages.
            report_period_ns: Time from one report of a drive to the next.
            clock_ns: The driver's time.
        """
        self.drives = [DriveState(label) for label in labels]
        self._min_reply_ns = round(MIN_REPLY_REPORTS * report_period_ns)
        self._max_follow_ns = MAX_FOLLOW_REPORTS * report_period_ns
        self._clock_ns = clock_ns

    def note_report(self, i: int, *, enabled: bool, state: str) -> None:
        """Store whether a drive reports that it is on, and its state in words.

        Args:
            i: Index of the drive.
            enabled: Whether it is on.
            state: Its state in the driver type's words, for messages.
        """
        drive = self.drives[i]
        drive.enabled = enabled
        drive.state = state
        drive.reported_ns = self._clock_ns()
        if drive.should_follow and enabled and self._has_replied(drive):
            drive.has_followed = True

    def next_commands(self, following: frozenset[int], *, emergency: bool) -> list[tuple[int, DriveCommand]]:
        """Return the commands to send now: to drives that change, and again to those that did not obey.

        Args:
            following: Indices of the drives that should follow setpoints.
            emergency: Whether the others stop by their own emergency stop.

        Returns:
            Indices of drives with their commands, such as enable, disable or emergency stop.
        """
        commands: list[tuple[int, DriveCommand]] = []
        for i, drive in enumerate(self.drives):
            should_follow = i in following
            if drive.should_follow != should_follow:
                drive.should_follow = should_follow
                drive.has_followed = False
                drive.commanded_ns = self._clock_ns()
            elif not self._needs_repetition(drive):
                continue
            command = _choose_command(should_follow=should_follow, emergency=emergency)
            if emergency and not should_follow:
                drive.emergency_stopped = True
            commands.append((i, command))
        return commands

    def following_drives(self) -> frozenset[int]:
        """Return the drives that should follow and report that they are on."""
        return frozenset(i for i, drive in enumerate(self.drives) if drive.should_follow and drive.enabled)

    def reset_errors(self, drives: Iterable[int]) -> None:
        """Forget the errors of these drives, as the driver clears them."""
        for i in drives:
            self.drives[i].errors = ""
            self.drives[i].emergency_stopped = False

    def findings(self) -> list[Finding]:
        """Return a finding for each drive that reports errors, or that does not follow although it should."""
        findings: list[Finding] = []
        for i, drive in enumerate(self.drives):
            if drive.safe_torque_off:
                cause = f"{drive.label}: its safe-torque-off input is active; release it, then reset and arm"
                findings.append(Finding("safe_torque_off", cause, i))
            elif drive.errors:
                findings.append(Finding("drive_fault", f"{drive.label} reports {drive.errors}", i, alone=True))
            elif drive.should_follow and self._is_settled(drive) and not drive.enabled:
                cause = f"{drive.label} does not follow: it is {drive.state or 'in an unknown state'}"
                findings.append(Finding("drive_not_armed", cause, i, alone=drive.has_followed))
        return findings

    def _needs_repetition(self, drive: DriveState) -> bool:
        """Return whether a drive has reported that it did not obey.

        A drive that has followed, or has had time to, gets no second command to follow: it has stopped by itself, and
        that is a finding.
        """
        if drive.should_follow and self._is_settled(drive):
            return False
        return self._has_replied(drive) and drive.enabled not in (None, drive.should_follow)

    def _has_replied(self, drive: DriveState) -> bool:
        return drive.reported_ns - drive.commanded_ns > self._min_reply_ns

    def _is_settled(self, drive: DriveState) -> bool:
        return drive.has_followed or self._clock_ns() - drive.commanded_ns > self._max_follow_ns


def _choose_command(*, should_follow: bool, emergency: bool) -> DriveCommand:
    if should_follow:
        return "follow"
    if emergency:
        return "stop"
    return "idle"
