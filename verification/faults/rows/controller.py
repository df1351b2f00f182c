"""The controller's process is killed, frozen, or busy with something else; the host restarts."""

import time
from collections.abc import Callable, Iterator
from functools import partial
from signal import SIGCONT, SIGKILL, SIGSTOP

import msgspec

from snakesim_hal.wire.messages import JointMode
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import START_LIMIT_S, ProcessRobot, recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest
from verification.faults.stranger import send_raw

HANG_S = 0.5
REPLAYED = 10
REFUSED_S = 1.5  # until the status must have counted them
UNDER_WAY_S = 0.1  # until what a dead host has sent has come
LATCHED_S = 0.15  # how long a fault must be seen to stay, with a controller that commands again

Fail = Callable[[ProcessRobot, Observer], int]
Mend = Callable[[ProcessRobot], object]


def _trial(
    started_robot: ProcessRobot, observer: Observer, fail: Fail, mend: Mend
) -> InjectionTrial:
    started_robot.set_in_motion(observer)
    failed_ns = fail(started_robot, observer)
    # From the host itself: a controller that fills a processor also delays what the network brings.
    stopped = started_robot.host.wait_for_status(
        lambda status: status.lifecycle == "fault", failed_ns, "a fault because of the lease"
    )
    value = (stopped.at_ns - failed_ns) / 1e6
    observer.safe_after_ms(failed_ns)
    status = observer.first_fault(failed_ns)
    failures: list[str] = []
    if not any(fault.what == "lease_expired" for fault in status.faults):
        failures.append(f"not because of the lease: {status.reason}")
    if status.lease_holder is not None:
        failures.append(f"the lease is still {status.lease_holder}'s")
    mend(started_robot)
    observer.until(
        lambda: observer.status is not None and observer.status.lease_holder == "control",
        "control is back",
    )
    observer.forget()
    observer.watch(LATCHED_S)
    if observer.state() != "fault" or any(h.message.sequence is not None for h in observer.applied):
        failures.append(f"not latched: {observer.in_words()}")
    trial = recovered(observer, value, "; ".join(failures))
    return msgspec.structs.replace(
        trial, late_ms=started_robot.host.measure_extra_delay_ms(stopped)
    )


def _failing(fail: Fail, mend: Mend, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """fail: when it began, by the monotonic clock; mend: before the operator resets."""
    with robot(request) as (started_robot, observer):
        for _ in range(request.trials):
            yield _trial(started_robot, observer, fail, mend)


def _hang(_made: ProcessRobot, observer: Observer) -> int:
    """Its interpreter is busy, by the injector."""
    now_ns = time.monotonic_ns()
    observer.inject("control", "hang", "control", for_s=HANG_S)
    return now_ns


killed = partial(
    _failing,
    lambda started_robot, _: started_robot.signal("control", SIGKILL),
    lambda started_robot: started_robot.start("control"),
)
frozen = partial(
    _failing,
    lambda started_robot, _: started_robot.signal("control", SIGSTOP),
    lambda started_robot: started_robot.signal("control", SIGCONT),
)
suspended = partial(_failing, _hang, lambda _: None)


def host_restarts(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """The host is killed while moving and started again; what was streamed before is sent to the new one.

    The value: setpoints of the new host that were not passive, before an operator armed it.
    """
    with robot(request) as (started_robot, observer):
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            observer.watch(0.1)
            streamed = [arrival.payload for arrival in observer.commands][-REPLAYED:]
            epoch = observer.status.lease_epoch if observer.status else 0
            started_robot.signal("host", SIGKILL)
            observer.watch(UNDER_WAY_S)
            observer.forget()
            started_robot.start("host")
            observer.until(lambda: observer.statuses, "a status of the new host", START_LIMIT_S)
            observer.until(lambda: observer.applied, "the new host's setpoints")
            failures = _objections(observer, streamed)
            if observer.status is None or 0 < observer.status.lease_epoch <= epoch:
                failures.append(
                    f"the lease's epoch did not grow from {epoch}: {observer.in_words()}"
                )
            moved = sum(set(h.message.mode) != {JointMode.PASSIVE} for h in observer.applied)
            yield recovered(observer, float(moved), "; ".join(failures))
        request.note(f"in each trial {REPLAYED} commands of before were sent to the new host")


def _objections(observer: Observer, streamed: list[bytes]) -> list[str]:
    """What is not as it must be with a new host that is sent what its predecessor was."""

    def refused() -> int:
        return 0 if observer.status is None else sum(observer.status.commands_rejected.values())

    before = refused()
    for payload in streamed:
        send_raw(observer.session, payload)
    failures: list[str] = []
    try:
        observer.until(
            lambda: refused() >= before + len(streamed), "old commands refused", REFUSED_S
        )
    except TrialError:
        failures.append(f"{refused() - before} of {len(streamed)} old commands were refused")
    observer.watch(LATCHED_S)
    if {h.message.lifecycle for h in observer.statuses} != {"disarmed"}:
        failures.append(f"did not boot disarmed, and stay so: {observer.in_words()}")
    return failures
