"""A bounded log of faults: the first ones, the newest ones, and the one that stopped the robot last. Pure."""

from snakesim_hal.wire.messages import Fault

MAX_FAULTS = 32
FIRST_FAULTS = MAX_FAULTS // 2  # the first faults usually show the cause, so the report lists as many


class FaultLog:
    """The faults since some event. A full log drops faults between the first and the newest ones."""

    def __init__(self) -> None:
        self.stored: list[Fault] = []  # oldest first
        self.left_out = 0
        self._stop: Fault | None = None  # the newest that stopped the robot

    def add(self, fault: Fault, *, stops: bool) -> None:
        """Add a fault. `stops` means that the robot is in `fault` or `estop` now because of it."""
        if stops:
            self._stop = fault
        self.stored.append(fault)
        if len(self.stored) > MAX_FAULTS:
            # The fault that stopped the robot stays: then the one behind it is dropped.
            del self.stored[FIRST_FAULTS + (self.stored[FIRST_FAULTS] is self._stop)]
            self.left_out += 1
