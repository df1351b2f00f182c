"""What a driver finds wrong, each thing reported once until the robot's fault is cleared. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import Fault


@dataclass(frozen=True)
class Finding:
    """One detected fault."""

    what: str
    cause: str
    joint: int | None = None  # index, tail to head
    alone: bool = False  # whether the other joints are not affected

    @property
    def subject(self) -> tuple[str, int | str, bool]:
        """Findings with the same subject are reported once."""
        return self.what, self.cause if self.joint is None else self.joint, self.alone

    def to_fault(self, tick: int, joints: Sequence[str]) -> Fault:
        """As the contract has it. joints: names, tail to head."""
        return Fault(
            tick=tick,
            what=self.what,
            cause=self.cause[:500],
            joint=None if self.joint is None else joints[self.joint],
            reach="joint" if self.alone else "robot",
        )


class ReportedFindings:
    """Remembers which findings have been reported."""

    def __init__(self) -> None:
        self._told: set[tuple[str, int | str, bool]] = set()

    def filter_new(self, found: Iterable[Finding]) -> list[Finding]:
        """Those that are new; from now on they are not."""
        fresh = [finding for finding in found if finding.subject not in self._told]
        self._told.update(finding.subject for finding in fresh)
        return fresh

    def reset(self) -> None:
        """The fault was cleared: what persists is reported again."""
        self._told.clear()
