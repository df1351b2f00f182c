"""A full fault log keeps the first faults, the newest ones, and the fault that stopped the robot."""

from snakesim_hal.safety.fault_log import MAX_FAULTS, FaultLog
from snakesim_hal.wire.messages import Fault

# The message `RobotStatus` contains the faults since the reset and those since the start.
MAX_FAULTS_IN_STATUS = 64


def add_faults(log: FaultLog, ticks: range) -> None:
    for tick in ticks:
        log.add(Fault(tick=tick, what="late", cause="late"), stops_robot=False)


def list_ticks(log: FaultLog) -> list[int]:
    return [fault.tick for fault in log.faults]


def test_fault_log_when_full_keeps_the_first_and_newest() -> None:
    log = FaultLog()
    add_faults(log, range(100))
    assert list_ticks(log) == [*range(16), *range(84, 100)]
    assert log.dropped_count == 68


def test_fault_log_fits_twice_into_a_status() -> None:
    assert 2 * MAX_FAULTS <= MAX_FAULTS_IN_STATUS


def test_fault_log_when_full_keeps_the_fault_that_stopped() -> None:
    log = FaultLog()
    add_faults(log, range(16))
    log.add(Fault(tick=16, what="hot", cause="hot"), stops_robot=True)
    add_faults(log, range(17, 100))
    assert list_ticks(log) == [*range(17), *range(85, 100)]


def test_fault_log_of_a_second_stop_keeps_the_newest_stop() -> None:
    log = FaultLog()
    add_faults(log, range(16))
    log.add(Fault(tick=16, what="hot", cause="hot"), stops_robot=True)
    log.add(Fault(tick=17, what="estop", cause="estop"), stops_robot=True)
    add_faults(log, range(18, 100))
    assert list_ticks(log)[16] == 17
