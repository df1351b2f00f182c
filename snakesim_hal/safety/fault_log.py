"""A bounded log of faults: the first ones, the newest ones, and the one that stopped the robot last. Pure."""

from snakesim_hal.wire.messages import Fault

MAX_FAULTS = 32
# The first faults usually show the cause, so the report lists as many.
FIRST_FAULT_COUNT = MAX_FAULTS // 2


class FaultLog:
    """The faults since some event. A full log drops faults between the first and the newest ones."""

    def __init__(self) -> None:
        self.faults: list[Fault] = []  # oldest first
        self.dropped_count = 0
        self._last_stopping_fault: Fault | None = None

    def add(self, fault: Fault, *, stops_robot: bool) -> None:
        """Add a fault, and drop one from the middle of a full log.

        Args:
            fault: Fault to add.
            stops_robot: Whether the robot has entered `fault` or `estop` because of this fault.
        """
        if stops_robot:
            self._last_stopping_fault = fault
        self.faults.append(fault)
        if len(self.faults) > MAX_FAULTS:
            dropped_index = FIRST_FAULT_COUNT
            if self.faults[dropped_index] is self._last_stopping_fault:
                dropped_index += 1  # the fault that stopped the robot stays
            del self.faults[dropped_index]
            self.dropped_count += 1
