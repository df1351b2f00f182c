"""Measures a controller whose process is killed, frozen or busy, and a host that restarts while the robot moves."""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from signal import SIGCONT, SIGKILL, SIGSTOP

import msgspec

from snakesim_hal.wire.messages import JointMode
from verification.faults.command_forger import send_payload
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import START_TIMEOUT_S, ProcessRobot, recover_robot, start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest

HANG_DURATION_S = 0.5
RECORDED_S = 0.1  # in which commands are recorded before the host is killed
REPLAYED_COMMANDS = 10
REJECTION_TIMEOUT_S = 1.5  # until the status has counted the rejected commands
TRANSPORT_TIME_S = 0.1  # until everything that a killed host had sent has arrived
LATCHED_S = 0.15  # in which a fault must remain although the controller sends commands again

InjectFault = Callable[[ProcessRobot, Observer], int]
"""Makes the controller fail, and returns the time just before, by the monotonic clock in ns."""

EndFault = Callable[[ProcessRobot], object]
"""Makes the controller work again."""


# --- the controller fails ------------------------------------------------------------------------------------------


def _measure_failing_controller(
    inject_fault: InjectFault, end_fault: EndFault, request: MeasurementRequest
) -> Iterator[InjectionTrial]:
    """Make the controller fail while the robot moves.

    Yields:
        Trials whose value is the time from the failure to the status that reports the fault, in ms.
    """
    with start_robot(request) as (robot, observer):
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            yield _run_controller_trial(robot, observer, inject_fault, end_fault)


def _run_controller_trial(
    robot: ProcessRobot, observer: Observer, inject_fault: InjectFault, end_fault: EndFault
) -> InjectionTrial:
    failure_ns = inject_fault(robot, observer)
    # A controller that uses all of a processor also delays messages on the network, but not the private channel.
    stop = robot.host_watch.wait_for_status(
        lambda status: status.lifecycle == "fault", failure_ns, "a fault because of the lease"
    )
    delay_ms = (stop.at_ns - failure_ns) / 1e6
    observer.measure_stop_delay_ms(failure_ns)
    status = observer.wait_for_fault(failure_ns)
    failures: list[str] = []
    if not any(fault.what == "lease_expired" for fault in status.faults):
        failures.append(f"not because of the lease: {status.reason}")
    if status.lease_holder is not None:
        failures.append(f"the lease is still {status.lease_holder}'s")

    end_fault(robot)
    observer.wait_until(
        lambda: observer.status is not None and observer.status.lease_holder == "control",
        "control is back",
    )
    observer.forget()
    observer.listen_for(LATCHED_S)
    if observer.get_lifecycle() != "fault" or observer.has_applied_commands():
        failures.append(f"not latched: {observer.describe_status()}")
    trial = recover_robot(observer, delay_ms, failures)
    late_ms = robot.host_watch.measure_extra_delay_ms(stop)
    return msgspec.structs.replace(trial, late_ms=late_ms)


def _kill_controller(robot: ProcessRobot, _observer: Observer) -> int:
    return robot.send_signal("control", SIGKILL)


def _restart_controller(robot: ProcessRobot) -> None:
    robot.start_process("control")


def _freeze_controller(robot: ProcessRobot, _observer: Observer) -> int:
    return robot.send_signal("control", SIGSTOP)


def _resume_controller(robot: ProcessRobot) -> None:
    robot.send_signal("control", SIGCONT)


def _hang_controller(_robot: ProcessRobot, observer: Observer) -> int:
    """Keep the controller's interpreter busy for HANG_DURATION_S."""
    request_ns = time.monotonic_ns()
    observer.inject_fault("control", "hang", "control", for_s=HANG_DURATION_S)
    return request_ns


def _wait_for_nothing(_robot: ProcessRobot) -> None:
    """Do nothing: the controller stops hanging on its own."""


measure_killed_controller = partial(
    _measure_failing_controller, _kill_controller, _restart_controller
)
measure_frozen_controller = partial(
    _measure_failing_controller, _freeze_controller, _resume_controller
)
measure_hanging_controller = partial(
    _measure_failing_controller, _hang_controller, _wait_for_nothing
)


# --- the host restarts ---------------------------------------------------------------------------------------------


def measure_host_restart(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Kill the host while the robot moves, start a new one, and send it commands that the old one received.

    Yields:
        Trials whose value is the number of setpoints of the new host that were not passive before an operator armed it.
    """
    with start_robot(request) as (robot, observer):
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            yield _run_restart_trial(robot, observer)
        request.add_note(
            f"in each trial {REPLAYED_COMMANDS} commands for the old host were sent to the new host"
        )


def _run_restart_trial(robot: ProcessRobot, observer: Observer) -> InjectionTrial:
    observer.listen_for(RECORDED_S)
    old_payloads = [arrival.payload for arrival in observer.commands][-REPLAYED_COMMANDS:]
    old_epoch = observer.status.lease_epoch if observer.status else 0
    robot.send_signal("host", SIGKILL)
    observer.listen_for(TRANSPORT_TIME_S)
    observer.forget()
    robot.start_process("host")
    observer.wait_until(lambda: observer.statuses, "a status of the new host", START_TIMEOUT_S)
    observer.wait_until(lambda: observer.applied, "the new host's setpoints")
    failures = _send_old_commands(observer, old_payloads)
    if observer.status is None or 0 < observer.status.lease_epoch <= old_epoch:
        failures.append(
            f"the lease's epoch did not grow from {old_epoch}: {observer.describe_status()}"
        )
    active_count = sum(
        set(received.message.mode) != {JointMode.PASSIVE} for received in observer.applied
    )
    return recover_robot(observer, float(active_count), failures)


def _send_old_commands(observer: Observer, payloads: Sequence[bytes]) -> list[str]:
    """Send commands for the old host, and check that the new host rejects them and stays disarmed.

    Returns:
        A description of each violation.
    """
    rejected_before = _count_rejected_commands(observer)
    for payload in payloads:
        send_payload(observer.session, payload)

    def count_new() -> int:
        return _count_rejected_commands(observer) - rejected_before

    failures: list[str] = []
    try:
        observer.wait_until(
            lambda: count_new() >= len(payloads), "old commands rejected", REJECTION_TIMEOUT_S
        )
    except TrialError:
        failures.append(f"{count_new()} of {len(payloads)} old commands were rejected")
    observer.listen_for(LATCHED_S)
    if {received.message.lifecycle for received in observer.statuses} != {"disarmed"}:
        failures.append(f"did not start and stay disarmed: {observer.describe_status()}")
    return failures


def _count_rejected_commands(observer: Observer) -> int:
    """Return how many commands the host has rejected, by its newest status."""
    if observer.status is None:
        return 0
    return sum(observer.status.commands_rejected.values())
