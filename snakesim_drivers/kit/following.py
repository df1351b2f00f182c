"""Whether drives follow as they were told: whom to tell again, and who does not. Pure, for drives on any bus.

A driver type says what a drive reports of itself, and sends the words that come out of here.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from snakesim_drivers.kit.findings import Finding

DriveCommand = Literal["follow", "idle", "stop"]  # stop: the drive's own emergency stop

HEARD_AGAIN = 1.5  # reports after a word, before what a drive says of itself is of after it
FOLLOWS_WITHIN = 5  # reports


@dataclass
class DriveState:
    """One drive: what it was told, and what it said last."""

    who: str  # such as "joint_2 (node 2 on can0)"
    follows: bool = False  # as it was told
    followed: bool = False  # since then
    stopped: bool = False  # by an emergency stop, since the last clear
    told_ns: int = -1
    enabled: bool | None = None  # as it says; None: not yet
    state: str = ""  # in the driver_type's words
    said_ns: int = -1
    errors: str = ""  # in words; empty: none


class DriveStates:
    """All drives of a robot, tail to head."""

    def __init__(self, who: Sequence[str], says_every_ns: int, clock_ns: Callable[[], int]) -> None:
        """who: names for messages; says_every_ns: how often a drive reports its state."""
        self.drives = [DriveState(name) for name in who]
        self._again_ns, self._within_ns = round(HEARD_AGAIN * says_every_ns), FOLLOWS_WITHIN * says_every_ns
        self._clock_ns = clock_ns

    def says(self, i: int, *, enabled: bool, state: str) -> None:
        """What a drive reports of itself."""
        drive = self.drives[i]
        drive.enabled, drive.state, drive.said_ns = enabled, state, self._clock_ns()
        drive.followed |= drive.follows and enabled and self._heard(drive)

    def words(self, following: frozenset[int], *, emergency: bool) -> list[tuple[int, DriveCommand]]:
        """Who is to be told what now: those that change, and those that did not hear it."""
        told: list[tuple[int, DriveCommand]] = []
        for i, drive in enumerate(self.drives):
            changes = drive.follows != (i in following)
            if changes:
                drive.follows, drive.followed, drive.told_ns = i in following, False, self._clock_ns()
            elif drive.follows and self._late(drive):
                continue  # it follows; or it has been told often enough, and is a finding
            if changes or (self._heard(drive) and drive.enabled not in (None, drive.follows)):
                drive.stopped |= emergency and not drive.follows
                told.append((i, "follow" if drive.follows else "stop" if emergency else "idle"))
        return told

    def enabled(self) -> frozenset[int]:
        """Return the drives that were told to follow, and say that they do."""
        return frozenset(i for i, drive in enumerate(self.drives) if drive.follows and drive.enabled)

    def forgive(self, joints: Iterable[int]) -> None:
        """These are being cleared."""
        for i in joints:
            self.drives[i].errors, self.drives[i].stopped = "", False

    def findings(self) -> list[Finding]:
        """Drives that report errors, or do not follow."""
        found: list[Finding] = []
        for i, drive in enumerate(self.drives):
            if drive.errors:
                found.append(Finding("drive_fault", f"{drive.who} reports {drive.errors}", i, alone=True))
            elif drive.follows and self._late(drive) and not drive.enabled:
                cause = f"{drive.who} does not follow: it is {drive.state or 'in an unknown state'}"
                found.append(Finding("drive_not_armed", cause, i, alone=drive.followed))
        return found

    def _heard(self, drive: DriveState) -> bool:
        return drive.said_ns - drive.told_ns > self._again_ns

    def _late(self, drive: DriveState) -> bool:
        return drive.followed or self._clock_ns() - drive.told_ns > self._within_ns
