"""Joint modules and buses that fail, through the product's own injector, in a robot with all its processes.

Those of CAN alone are measured in periods of robot time, from the host's ticks: a machine that is late by some
milliseconds does not count, one that misses a period does. What sensors of any backend can do is measured from outside.
"""

import random
import re
import time
from collections.abc import Iterator, Sequence

from snakesim_can_backend.protocol.definitions import CommandAction
from snakesim_hal.model.fault_kinds import FaultInjection, validate_and_complete_injection
from snakesim_hal.wire.messages import Answer, RobotStatus
from verification.faults import bus_log
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import START_LIMIT_S, ProcessRobot, configuration, recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest

PERIOD_MS = 10.0
FAULT_DURATION_S = 0.3
REST_S = 0.4  # until all motors must be off
OFF_NM = 0.1  # what noise makes of none
# Of a bus that takes no frame any more: modules stop by themselves.
CUT_OFF = "cut", "bus_off", "full"
BUS_KINDS = (*CUT_OFF, "error_passive", "overflow")
BUS_LOG = "bus.log"
ROBOT_TIME_PATTERN = re.compile(r"at ([0-9.]+) s of robot time")


def at_host(kind: str, what: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Inject a fault of joint_N or bus_1 on CAN into the host. what: the name that the driver gives it.

    The value: from its beginning, which is just before a Sync, to the stop mode, which goes out where the setpoints
    of that period would have; for a module from its last good answer, a period earlier.
    """
    rng, log = random.Random(5), request.folder / BUS_LOG
    with robot(request, backend__log=str(log)) as (started_robot, observer):
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            number = rng.randrange(len(observer.description().joints)) + 1
            injection = FaultInjection(kind, "bus_1" if kind in BUS_KINDS else f"joint_{number}")
            yield injected(observer, injection, [what], PERIOD_MS)
    stops = bus_log.commands(bus_log.read(log), CommandAction.STOP)
    if kind not in CUT_OFF and stops < request.trials:
        raise TrialError(f"{stops} Stops on the bus in {request.trials} trials")
    request.note("the real host process, in real time; counted in its periods")


def injected(
    observer: Observer, injection: FaultInjection, what: Sequence[str], period_ms: float
) -> InjectionTrial:
    """Inject a fault once, and return the trial. what: names that the driver may give it; period_ms: of the host."""
    injection, requested_ns = validate_and_complete_injection(injection), time.monotonic_ns()
    answer = observer.inject("hal", injection.kind, injection.target, for_s=FAULT_DURATION_S)
    begun = _begun_tick(answer, period_ms)
    status = observer.first_fault(requested_ns)
    found = min(
        (fault for fault in status.faults if fault.tick >= begun),
        key=lambda fault: fault.tick,
        default=None,
    )
    if found is None:
        return InjectionTrial(
            value=None, failure=f"nothing found after tick {begun}: {status.faults}"
        )
    observer.watch(REST_S)
    failures = _objections(observer, injection, what, requested_ns)
    if injection.target_type == "joint" and found.joint != injection.target:
        failures.append(f"{found.joint} was named, not {injection.target}: {found.cause}")
    observer.watch(FAULT_DURATION_S)
    periods = found.tick - begun + (2 if injection.target_type == "joint" else 1)
    return recovered(observer, period_ms * periods, "; ".join(failures))


def _begun_tick(answer: Answer, period_ms: float) -> int:
    """Return the first tick that a fault concerns: it begins before the Sync."""
    match = ROBOT_TIME_PATTERN.search(answer.reason)
    if match is None:
        raise TrialError(f"the injector does not report the time: {answer.reason}")
    return round(float(match[1]) * 1000 / period_ms)


def _objections(
    observer: Observer, injection: FaultInjection, what: Sequence[str], requested_ns: int
) -> list[str]:
    """Return every condition that is not met after the stop mode."""
    failures: list[str] = []
    reported: list[RobotStatus] = [
        received.message for received in observer.statuses if received.at_ns >= requested_ns
    ]
    words = {fault.what for status in reported for fault in status.faults}
    if words.isdisjoint(what):
        failures.append(f"found as {sorted(words)}, not {' or '.join(what)}")
    if observer.state() != "fault":
        failures.append(f"not latched: {observer.in_words()}")
    joints = observer.joints[max(observer.joints)]
    aside = {injection.target_index} if injection.target_type == "joint" else set[int]()
    torques = [
        abs(torque)
        for i, (torque, valid) in enumerate(zip(joints.torque_nm, joints.valid, strict=True))
        if valid and i not in aside
    ]
    if max(torques, default=0.0) > OFF_NM:
        failures.append(f"a motor still gives {max(torques):.2f} N·m after {REST_S:g} s")
    return failures


def twice_at_start(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Open a bus on which two modules have one node id. The value: modules that the host enabled all the same."""
    joints = configuration("can").robot.chain.modules
    for number in range(request.trials):
        joint, folder = f"joint_{number % joints + 1}", request.folder / str(number)
        folder.mkdir()
        log = folder / BUS_LOG
        config = configuration(
            "can", backend__log=str(log), backend__faults=[f"duplicate:{joint}@0"]
        )
        with ProcessRobot(folder, config) as started_robot:
            host = started_robot.start("host")
            host.process.wait(START_LIMIT_S)
            words = "\n".join(host.output.last_lines())
        failure = "" if joint in words and "2 times" in words else f"in other words: {words}"
        frames = bus_log.read(log)
        yield InjectionTrial(
            value=float(bus_log.commands(frames, CommandAction.ARM) + bus_log.setpoints(frames)),
            failure=failure,
        )
    request.note(
        "the real host process, which reports why it refuses; enabled is what its bus log shows"
    )


def through_robot(kind: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Let a joint's sensor fail while the robot moves.

    The value: from the request to the injector to the first safe setpoints that were received.
    """
    rng = random.Random(6)
    with robot(request) as (started_robot, observer):
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            joint = f"joint_{rng.randrange(len(observer.description().joints)) + 1}"
            requested_ns = time.monotonic_ns()
            observer.inject("hal", kind, joint, for_s=FAULT_DURATION_S)
            value = observer.safe_after_ms(requested_ns)
            status = observer.first_fault(requested_ns)
            failures: list[str] = []
            if not any(joint in fault.cause or fault.joint == joint for fault in status.faults):
                failures.append(
                    f"{joint} was not named: {[fault.cause for fault in status.faults]}"
                )
            observer.watch(FAULT_DURATION_S)
            yield recovered(observer, value, "; ".join(failures))
