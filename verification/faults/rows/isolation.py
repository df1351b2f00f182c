"""Measures a joint that fails in a robot that may isolate one joint: only this joint is disabled, until a reset."""

import random
import time
from collections.abc import Iterator
from typing import Any

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, JointMode, LifecycleRequest
from verification.faults.observer import Observer, ReceivedMessage, TrialError
from verification.faults.robot import recover_robot, start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest

FAULT_DURATION_S = 0.3
OBSERVED_S = 0.1  # after the end of the fault, in which the other joints must continue
TIMEOUT_S = 3.0  # for the isolation, and for its end
ONE_ISOLATED_JOINT: dict[str, Any] = {"robot__safety__max_isolated_joints": 1}


def measure_isolated_joint(kind: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Let a random joint fail while the robot moves.

    Args:
        kind: Kind of the fault.
        request: Measurement to make.

    Yields:
        Trials whose value is the time from the request to the first setpoints in which the joint is passive, in ms.
    """
    rng = random.Random(7)
    with start_robot(request, **ONE_ISOLATED_JOINT) as (robot, observer):
        joint_names = [joint.name for joint in observer.get_description().joints]
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            joint = rng.randrange(len(joint_names))
            request_ns = time.monotonic_ns()
            observer.inject_fault("hal", kind, joint_names[joint], for_s=FAULT_DURATION_S)
            isolation = _wait_for_passive_joint(observer, joint, request_ns)
            delay_ms = (isolation.at_ns - request_ns) / 1e6
            observer.listen_for(FAULT_DURATION_S + OBSERVED_S)
            failures = _check_isolation(observer, joint_names[joint], request_ns)
            _end_isolation(observer)
            yield recover_robot(observer, delay_ms, failures)


def _wait_for_passive_joint(
    observer: Observer, joint: int, since_ns: int
) -> ReceivedMessage[AppliedCommand]:
    """Return the first setpoints after a time that answer a controller's command and leave a joint passive."""

    def find_passive() -> ReceivedMessage[AppliedCommand] | None:
        for received in observer.applied:
            applied = received.message
            is_passive = applied.mode[joint] is JointMode.PASSIVE
            if received.at_ns >= since_ns and is_passive and applied.sequence is not None:
                return received
        return None

    return observer.wait_until(find_passive, "the joint is disabled", TIMEOUT_S)


def _check_isolation(observer: Observer, joint_name: str, since_ns: int) -> list[str]:
    """Check that only this joint is isolated and named, and that the others did not stop.

    Returns:
        A description of each violation.
    """
    status = observer.status
    if status is None:
        raise TrialError("no status")
    failures: list[str] = []
    if status.lifecycle != "armed":
        failures.append(f"the robot stopped: {observer.describe_status()}")
    if status.isolated != [joint_name]:
        failures.append(f"{status.isolated} are isolated, not {joint_name}")
    if [fault.joint for fault in status.faults] != [joint_name]:
        causes = [fault.cause for fault in status.faults]
        failures.append(f"{joint_name} is not the only named joint: {causes}")
    stop = observer.find_stop_setpoints(since_ns)
    if stop is not None:
        failures.append(f"the host stopped all joints at tick {stop.message.tick}")
    return failures


def _end_isolation(observer: Observer) -> None:
    """Disarm and reset the robot, which ends the isolation of its joints."""
    for action in ("disarm", "reset"):
        observer.send_request(keys.LIFECYCLE, LifecycleRequest(action=action))
    observer.wait_until(
        lambda: observer.status is not None and not observer.status.isolated,
        "the isolation has ended",
        TIMEOUT_S,
    )
