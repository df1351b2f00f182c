"""A bounded log of faults: the first ones, the newest ones, and the one that stopped the robot last. Pure."""

from snakesim_hal.wire.messages import Fault

MAX_FAULTS_KEPT = 32
FIRST_KEPT = MAX_FAULTS_KEPT // 2  # as the report takes it


class FaultLog:
    """The dropped ones came between the first and the newest."""

    def __init__(self) -> None:
        self.kept: list[Fault] = []  # in order of time
        self.left_out = 0
        self._stop: Fault | None = None  # the newest that stopped the robot

    def add(self, fault: Fault, *, stops: bool) -> None:
        """Add one. stops: it is why the robot is in `fault` or `estop` now."""
        if stops:
            self._stop = fault
        self.kept.append(fault)
        if len(self.kept) > MAX_FAULTS_KEPT:
            del self.kept[FIRST_KEPT + (self.kept[FIRST_KEPT] is self._stop)]
            self.left_out += 1
