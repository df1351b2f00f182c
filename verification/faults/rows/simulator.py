"""Measures a simulator that is slower than real time, and a simulation that diverges."""

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.run_log.black_box import read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD, HostRecord
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import START_TIMEOUT_S, recover_robot, start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest

SLOW_FRACTION = 0.1  # of real time
MAX_SLOW_FRACTION = 2 * SLOW_FRACTION  # a faster simulator was not slowed down
WINDOW_TICKS = 15
WINDOW_TIMEOUT_S = 30.0
MAX_STEP_RAD = 0.2  # of a joint within one period; a diverged joint is farther away


def measure_slow_simulator(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Run in lockstep at a tenth of real time.

    Yields:
        A trial for each window of WINDOW_TICKS. Its value is the number of stops and faults in the window.
    """
    with start_robot(request, clock_mode="lockstep") as (_, observer):
        observer.inject_fault("hal", "slow", "simulator", amount=SLOW_FRACTION)
        fractions: list[float] = []
        for _ in range(request.trials):
            yield _observe_slow_window(observer, fractions)
        observer.inject_fault("hal", "slow", "simulator", end=True)
        request.add_note(
            f"{WINDOW_TICKS} ticks each, at {min(fractions):.3f} to {max(fractions):.3f} of real time"
        )


def _observe_slow_window(observer: Observer, fractions: list[float]) -> InjectionTrial:
    """Observe one window, and add its speed as a fraction of real time to `fractions`."""
    observer.forget()
    observer.wait_until(
        lambda: len(observer.clocks) > WINDOW_TICKS or observer.get_lifecycle() != "armed",
        "ticks",
        WINDOW_TIMEOUT_S,
    )
    fault_count = len(observer.status.faults) if observer.status is not None else 0
    stop_count = sum(received.message.sequence is None for received in observer.applied)
    if len(observer.clocks) > 2:
        # The first tick may have begun before the window.
        measured_s = (observer.clocks[-1].at_ns - observer.clocks[1].at_ns) * 1e-9
        simulated_s = (len(observer.clocks) - 2) * observer.get_description().period_ns * 1e-9
        fractions.append(simulated_s / measured_s)
    failure = ""
    if observer.get_lifecycle() != "armed":
        failure = f"stopped: {observer.describe_status()}"
    elif fractions and fractions[-1] > MAX_SLOW_FRACTION:
        failure = f"the simulator was not slow: {fractions[-1]:.2f} of real time"
    return InjectionTrial(value=float(fault_count + stop_count), failure=failure)


def measure_divergence(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Make the state of the simulation impossible while the robot moves. Then start a new host, and arm it.

    Yields:
        Trials whose value is the number of steps from the injection to the fault.
    """
    with start_robot(request) as (robot, observer):
        record_path = request.folder / HOST_RECORD
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            record_path.unlink(missing_ok=True)
            observer.inject_fault("hal", "diverge", "simulator")
            robot.running["host"].process.wait(START_TIMEOUT_S)
            observer.listen()
            record = msgspec.json.decode(record_path.read_bytes(), type=HostRecord)
            step_count = _count_steps_to_fault(record)
            failures = _check_last_states(record, request.folder, observer)
            observer.forget()
            robot.start_process("host")
            observer.wait_until(
                lambda: observer.statuses, "a status of the new host", START_TIMEOUT_S
            )
            yield recover_robot(observer, float(step_count), failures)
        request.add_note(
            "the host process ends after a divergence, with its record; a new one was started and armed"
        )


def _count_steps_to_fault(record: HostRecord) -> int:
    """Return how many steps the simulation made until the fault, the diverging one included."""
    fault = next((fault for fault in record.faults if "diverged" in fault.cause), None)
    if fault is None:
        raise TrialError(f"no divergence among {record.faults}")
    # For example `tick 31: diverge:simulator@...`.
    injection = next(text for text in record.injected if "diverge" in text)
    injection_tick = int(injection.removeprefix("tick ").partition(":")[0])
    return fault.tick - injection_tick + 1


def _check_last_states(record: HostRecord, folder: Path, observer: Observer) -> list[str]:
    """Check that the host ended in a fault, and that its last recorded and published states are finite.

    Returns:
        A description of each violation.
    """
    failures: list[str] = []
    if record.lifecycle != "fault":
        failures.append(f"the host ended {record.lifecycle}")
    _, box = read_black_box(folder / BLACK_BOX)
    recorded_rad = box["angle_rad"]
    if not np.isfinite(recorded_rad).all():
        failures.append("a state that is no number was recorded")
    published_rad = observer.joints[max(observer.joints)].angle_rad
    if not all(map(math.isfinite, published_rad)):
        failures.append("a state that is no number was published")
    elif np.abs(np.array(published_rad) - recorded_rad[-1]).max() > MAX_STEP_RAD:
        failures.append("the last state that was published is not the last good one")
    return failures
