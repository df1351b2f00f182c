"""What a driver finds wrong. Each finding is reported once until the operator resets the fault. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import Fault

MAX_CAUSE_CHARACTERS = 500  # the limit of the message `Fault`


@dataclass(frozen=True)
class FaultFinding:
    """One detected fault."""

    what: str  # kind of the fault, such as drive_silent
    cause: str  # for the operator
    joint: int | None = None  # index, tail to head (None: the bus)
    affects_only_joint: bool = False  # True: the other joints are not affected

    @property
    def subject(self) -> tuple[str, int | str, bool]:
        """The key by which a finding is reported once: its kind and joint, or its cause if it has no joint."""
        place = self.cause if self.joint is None else self.joint
        return self.what, place, self.affects_only_joint

    def to_fault(self, tick: int, joint_names: Sequence[str]) -> Fault:
        """Return the finding as a `Fault` message.

        Args:
            tick: Number of the control cycle in which it was found.
            joint_names: Names of all joints, from tail to head.
        """
        return Fault(
            tick=tick,
            what=self.what,
            cause=self.cause[:MAX_CAUSE_CHARACTERS],
            joint=None if self.joint is None else joint_names[self.joint],
            scope="joint" if self.affects_only_joint else "robot",
        )


class ReportedFindings:
    """Remembers which findings have been reported."""

    def __init__(self) -> None:
        self._subjects: set[tuple[str, int | str, bool]] = set()

    def filter_new(self, findings: Iterable[FaultFinding]) -> list[FaultFinding]:
        """Return the findings that have not been reported, and remember them as reported."""
        new_findings = [finding for finding in findings if finding.subject not in self._subjects]
        self._subjects.update(finding.subject for finding in new_findings)
        return new_findings

    def reset(self) -> None:
        """Forget all findings after a reset of the fault: those that persist are reported again."""
        self._subjects.clear()
