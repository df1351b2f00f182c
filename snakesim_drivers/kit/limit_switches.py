"""Limit switches at the ends of a joint's travel. Pure.

A switch that closes is a fault of its joint. After the operator's reset the joint may move away from the switch and not
further into it: without the first it could never leave the switch, without the second it would hit its end.
"""

from collections.abc import Sequence

from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import JointMode


class LimitSwitches:
    """The switches of all drives on one bus, by their indices on it. Lower and upper are at the drive's shaft."""

    def __init__(self, labels: Sequence[str]) -> None:
        """Create the switches of a bus, all open; `labels` are the names of the drives for messages."""
        self._labels = labels
        self._at_lower: set[int] = set()
        self._at_upper: set[int] = set()
        self._unacknowledged: set[int] = set()  # closed since the last reset

    def record_switches(self, i: int, *, lower: bool, upper: bool) -> None:
        """Store which limit switches of a drive are closed.

        Args:
            i: Index of the drive.
            lower: Whether the switch at the lower end of the travel is closed.
            upper: Whether the switch at the upper end of the travel is closed.
        """
        for is_closed, closed in ((lower, self._at_lower), (upper, self._at_upper)):
            if is_closed and i not in closed:
                closed.add(i)
                self._unacknowledged.add(i)
            elif not is_closed:
                closed.discard(i)

    def reset(self, drives: frozenset[int]) -> None:
        """Forget the findings of these drives, after the operator's reset; closed switches still restrict motion."""
        self._unacknowledged -= drives

    def list_findings(self) -> list[FaultFinding]:
        """Return a finding for each drive whose switch has closed since the last reset."""
        findings: list[FaultFinding] = []
        for i in sorted(self._unacknowledged):
            cause = f"{self._labels[i]} has reached its {self._name_end(i)} limit switch; reset, and move away from it"
            findings.append(FaultFinding("limit_switch", cause, i, affects_only_joint=True))
        return findings

    def restrict_command(self, command: BusCommand, angle_rad: Floats) -> BusCommand:
        """Return the command without motion into a closed limit switch.

        Args:
            command: Command for drives without limit switches.
            angle_rad: Measured angles of the shafts, (n_drives,).
        """
        if not self._at_lower and not self._at_upper:
            return command
        targets = command.targets.copy()
        for i in command.enabled_drives:
            bound = float(angle_rad[i]) if command.modes[i] == JointMode.POSITION else 0.0
            if i in self._at_lower:
                targets[i] = max(targets[i], bound)
            if i in self._at_upper:
                targets[i] = min(targets[i], bound)
        return command._replace(targets=targets)

    def _name_end(self, i: int) -> str:
        if i in self._at_lower:
            return "lower"
        if i in self._at_upper:
            return "upper"
        return "lower or upper"
