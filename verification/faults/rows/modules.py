"""Measures joint modules and buses that fail, and sensors of joints that fail.

The product's own injector causes the faults, in a robot with all its processes. Faults of the backend `can` alone are
measured in control periods of the host: a delay of some milliseconds does not count, a missed period does. Faults of
sensors of any backend are measured by the observer.
"""

import random
import re
import time
from collections.abc import Iterator, Sequence

from snakesim_can_backend.protocol.definitions import CommandAction
from snakesim_hal.model.fault_kinds import FaultInjection, validate_and_complete_injection
from snakesim_hal.wire.messages import Answer, Fault
from verification.faults import bus_log
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import (
    START_TIMEOUT_S,
    ProcessRobot,
    make_config,
    recover_robot,
    start_robot,
)
from verification.faults.row import InjectionTrial, MeasurementRequest

PERIOD_MS = 10.0
FAULT_DURATION_S = 0.3
BRAKING_S = 0.4  # after which all motors must be off
MAX_OFF_TORQUE_NM = 0.1  # measured at a motor that is off, because of noise
DISCONNECTING_KINDS = ("cut", "bus_off", "full")  # no frame reaches a module: it stops by itself
BUS_KINDS = (*DISCONNECTING_KINDS, "error_passive", "overflow")
BUS_LOG = "bus.log"
ROBOT_TIME_PATTERN = re.compile(r"at ([0-9.]+) s of robot time")


# --- a joint module or a bus fails ---------------------------------------------------------------------------------


def measure_injected_fault(
    kind: str, fault_name: str, request: MeasurementRequest
) -> Iterator[InjectionTrial]:
    """Inject a fault of a random joint module or of the first CAN bus.

    Args:
        kind: Kind of the fault.
        fault_name: Name that the driver must report.
        request: Measurement to make.

    Yields:
        Trials whose value is the time until the stop mode in ms, see `run_injection_trial`.
    """
    rng = random.Random(5)
    log_path = request.folder / BUS_LOG
    with start_robot(request, backend__log=str(log_path)) as (robot, observer):
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            number = rng.randrange(len(observer.get_description().joints)) + 1
            target = "bus_1" if kind in BUS_KINDS else f"joint_{number}"
            injection = FaultInjection(kind, target)
            yield run_injection_trial(observer, injection, [fault_name], PERIOD_MS)
    stop_count = bus_log.count_commands(bus_log.read_frames(log_path), CommandAction.STOP)
    if kind not in DISCONNECTING_KINDS and stop_count < request.trials:
        raise TrialError(f"{stop_count} Stops on the bus in {request.trials} trials")
    request.add_note("the real host process, in real time; counted in its periods")


def run_injection_trial(
    observer: Observer, injection: FaultInjection, fault_names: Sequence[str], period_ms: float
) -> InjectionTrial:
    """Inject a fault once while the robot moves.

    The measured time begins just before the Sync of the first tick with the fault. For a joint it begins one period
    earlier, with the last good answer. It ends with the period whose setpoints are those of the stop mode.

    Args:
        observer: Observer of the robot.
        injection: Fault to inject.
        fault_names: Names that the driver may report.
        period_ms: Control period of the host.

    Returns:
        The trial. Its value is the measured time in ms.
    """
    injection = validate_and_complete_injection(injection)
    request_ns = time.monotonic_ns()
    answer = observer.inject_fault("hal", injection.kind, injection.target, for_s=FAULT_DURATION_S)
    first_tick = _read_first_tick(answer, period_ms)
    status = observer.wait_for_fault(request_ns)
    new_faults = [fault for fault in status.faults if fault.tick >= first_tick]
    if not new_faults:
        failure = f"nothing found after tick {first_tick}: {status.faults}"
        return InjectionTrial(value=None, failure=failure)
    fault = min(new_faults, key=lambda fault: fault.tick)
    observer.listen_for(BRAKING_S)
    failures = [
        *_check_reported_names(observer, fault_names, request_ns),
        *_check_stopped(observer, injection),
        *_check_reported_joint(fault, injection),
    ]
    observer.listen_for(FAULT_DURATION_S)
    period_count = fault.tick - first_tick + 1
    if injection.target_type == "joint":
        period_count += 1
    return recover_robot(observer, period_ms * period_count, failures)


def _read_first_tick(answer: Answer, period_ms: float) -> int:
    """Return the first tick with the fault, from the answer of the injector. The fault begins before its Sync."""
    match = ROBOT_TIME_PATTERN.search(answer.reason)
    if match is None:
        raise TrialError(f"the injector does not report the time: {answer.reason}")
    return round(float(match[1]) * 1000 / period_ms)


def _check_reported_names(
    observer: Observer, fault_names: Sequence[str], since_ns: int
) -> list[str]:
    """Return a violation if no status since a time reports a fault by one of these names."""
    reported_names = {
        fault.what
        for received in observer.statuses
        if received.at_ns >= since_ns
        for fault in received.message.faults
    }
    if not reported_names.isdisjoint(fault_names):
        return []
    return [f"found as {sorted(reported_names)}, not {' or '.join(fault_names)}"]


def _check_stopped(observer: Observer, injection: FaultInjection) -> list[str]:
    """Return a violation if the fault is not latched, and one if the motor of another joint still has torque."""
    failures: list[str] = []
    if observer.get_lifecycle() != "fault":
        failures.append(f"not latched: {observer.describe_status()}")
    failed_joint = injection.target_index if injection.target_type == "joint" else None
    state = observer.joints[max(observer.joints)]
    torques_nm = [
        abs(torque_nm)
        for i, (torque_nm, is_valid) in enumerate(zip(state.torque_nm, state.valid, strict=True))
        if is_valid and i != failed_joint
    ]
    max_torque_nm = max(torques_nm, default=0.0)
    if max_torque_nm > MAX_OFF_TORQUE_NM:
        failures.append(f"a motor still gives {max_torque_nm:.2f} N·m after {BRAKING_S:g} s")
    return failures


def _check_reported_joint(fault: Fault, injection: FaultInjection) -> list[str]:
    """Return a violation if a fault of a joint names another joint."""
    if injection.target_type != "joint" or fault.joint == injection.target:
        return []
    return [f"{fault.joint} was named, not {injection.target}: {fault.cause}"]


# --- two modules have the same node id -----------------------------------------------------------------------------


def measure_duplicate_at_start(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Start the host with a bus on which two modules have the same node id. The host must refuse to start.

    Yields:
        Trials whose value is the number of frames with which the host enabled a module.
    """
    joint_count = make_config("can").robot.chain.modules
    for number in range(request.trials):
        joint = f"joint_{number % joint_count + 1}"
        folder = request.folder / str(number)
        folder.mkdir()
        log_path = folder / BUS_LOG
        config = make_config(
            "can", backend__log=str(log_path), backend__faults=[f"duplicate:{joint}@0"]
        )
        with ProcessRobot(folder, config) as robot:
            host = robot.start_process("host")
            host.process.wait(START_TIMEOUT_S)
            output = "\n".join(host.output.last_lines())
        is_explained = joint in output and "2 times" in output
        frames = bus_log.read_frames(log_path)
        enabling_count = bus_log.count_commands(frames, CommandAction.ARM)
        enabling_count += bus_log.count_setpoints(frames)
        yield InjectionTrial(
            value=float(enabling_count),
            failure="" if is_explained else f"the host gives another reason: {output}",
        )
    request.add_note(
        "the real host process, which reports why it refuses; enabled is what its bus log shows"
    )


# --- a sensor of a joint fails -------------------------------------------------------------------------------------


def measure_failing_sensor(kind: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Let the sensor of a random joint fail while the robot moves, with any backend.

    Args:
        kind: Kind of the fault.
        request: Measurement to make.

    Yields:
        Trials whose value is the time from the request to the injector to the setpoints of the stop mode, in ms.
    """
    rng = random.Random(6)
    with start_robot(request) as (robot, observer):
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            joint = f"joint_{rng.randrange(len(observer.get_description().joints)) + 1}"
            request_ns = time.monotonic_ns()
            observer.inject_fault("hal", kind, joint, for_s=FAULT_DURATION_S)
            delay_ms = observer.measure_stop_delay_ms(request_ns)
            status = observer.wait_for_fault(request_ns)
            failures: list[str] = []
            if not any(joint in fault.cause or fault.joint == joint for fault in status.faults):
                causes = [fault.cause for fault in status.faults]
                failures.append(f"{joint} was not named: {causes}")
            observer.listen_for(FAULT_DURATION_S)
            yield recover_robot(observer, delay_ms, failures)
