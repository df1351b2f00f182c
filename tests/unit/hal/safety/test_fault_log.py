"""A full fault log keeps the first faults, the newest ones, and the fault that stopped the robot.

A fault is recognized by its tick: each test adds one fault per tick, from tick 0 on.
"""

from snakesim_hal.safety.fault_log import MAX_FAULTS, FaultLog
from snakesim_hal.wire.messages import Fault

# The message `RobotStatus` contains the faults since the reset and those since the start.
MAX_FAULTS_IN_STATUS = 64

# A full log has 32 faults. A fault that stopped the robot takes the place of one of the newest faults.
FIRST_COUNT = 16  # faults that stay from the start of the log
NEWEST_COUNT = 16  # faults that stay from its end
TICK_COUNT = 100  # faults that each test adds, which is more than a log has places


def add_faults(log: FaultLog, ticks: range) -> None:
    """Add a fault at each tick that does not stop the robot."""
    for tick in ticks:
        log.add(Fault(tick=tick, what="late", cause="late"), stops_robot=False)


def add_stop(log: FaultLog, tick: int, what: str) -> None:
    """Add a fault that stops the robot."""
    log.add(Fault(tick=tick, what=what, cause=what), stops_robot=True)


def list_ticks(log: FaultLog) -> list[int]:
    return [fault.tick for fault in log.faults]


def test_fault_log_when_full_keeps_the_first_and_newest() -> None:
    log = FaultLog()

    add_faults(log, range(TICK_COUNT))

    first_ticks = range(FIRST_COUNT)
    newest_ticks = range(TICK_COUNT - NEWEST_COUNT, TICK_COUNT)
    assert list_ticks(log) == [*first_ticks, *newest_ticks]


def test_fault_log_when_full_counts_the_dropped_faults() -> None:
    log = FaultLog()

    add_faults(log, range(TICK_COUNT))

    assert log.dropped_count == TICK_COUNT - FIRST_COUNT - NEWEST_COUNT


def test_fault_log_fits_twice_into_a_status() -> None:
    assert 2 * MAX_FAULTS <= MAX_FAULTS_IN_STATUS, "a status with two full logs cannot be sent"


def test_fault_log_when_full_keeps_the_fault_that_stopped() -> None:
    log = FaultLog()
    stop_tick = FIRST_COUNT  # the first place from which a full log drops faults

    add_faults(log, range(stop_tick))
    add_stop(log, stop_tick, "hot")
    add_faults(log, range(stop_tick + 1, TICK_COUNT))

    first_ticks = range(FIRST_COUNT)
    newest_ticks = range(TICK_COUNT - NEWEST_COUNT + 1, TICK_COUNT)
    assert list_ticks(log) == [*first_ticks, stop_tick, *newest_ticks]


def test_fault_log_of_a_second_stop_keeps_the_newest_stop() -> None:
    """The log has one place for a stop. The status must explain why the robot is stopped now."""
    log = FaultLog()
    old_stop_tick = FIRST_COUNT  # both stops are where a full log drops faults
    new_stop_tick = old_stop_tick + 1

    add_faults(log, range(old_stop_tick))
    add_stop(log, old_stop_tick, "hot")
    add_stop(log, new_stop_tick, "estop")
    add_faults(log, range(new_stop_tick + 1, TICK_COUNT))

    first_ticks = range(FIRST_COUNT)
    newest_ticks = range(TICK_COUNT - NEWEST_COUNT + 1, TICK_COUNT)
    assert list_ticks(log) == [*first_ticks, new_stop_tick, *newest_ticks], (
        "the new stop stays, and the old one is dropped as any other fault"
    )
