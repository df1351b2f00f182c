"""A joint that fails in a robot that may lose one: it alone is let go, until a person takes it back."""

import random
import time
from collections.abc import Iterator
from typing import Any

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, JointMode, LifecycleRequest
from verification.faults.observer import Observer, ReceivedMessage, TrialError
from verification.faults.robot import recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest

FAULT_DURATION_S = 0.3
MORE_S = 0.1  # that the others are watched for, when the joint is sound again
MAY_LOSE_ONE: dict[str, Any] = {"robot__safety__max_isolated_joints": 1}


def set_aside(kind: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """The value: from the request to the injector to the first setpoints that leave the joint passive."""
    rng = random.Random(7)
    with robot(request, **MAY_LOSE_ONE) as (started_robot, observer):
        names = [joint.name for joint in observer.description().joints]
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            joint = rng.randrange(len(names))
            requested_ns = time.monotonic_ns()
            observer.inject("hal", kind, names[joint], for_s=FAULT_DURATION_S)
            value = (_let_go(observer, joint, requested_ns).at_ns - requested_ns) / 1e6
            observer.watch(FAULT_DURATION_S + MORE_S)
            failures = _objections(observer, names[joint], requested_ns)
            _take_back(observer)
            yield recovered(observer, value, "; ".join(failures))


def _let_go(observer: Observer, joint_index: int, since_ns: int) -> ReceivedMessage[AppliedCommand]:
    """The first setpoints without the joint; by the controller, not by the host alone."""

    def found() -> list[ReceivedMessage[AppliedCommand]]:
        passive = (
            h
            for h in observer.applied
            if h.at_ns >= since_ns and h.message.mode[joint_index] is JointMode.PASSIVE
        )
        return [received for received in passive if received.message.sequence is not None]

    return observer.until(found, "the joint is let go", 3.0)[0]


def _objections(observer: Observer, name: str, since_ns: int) -> list[str]:
    status = observer.status
    if status is None:
        raise TrialError("no status")
    failures: list[str] = []
    if status.lifecycle != "armed":
        failures.append(f"the robot stopped: {observer.in_words()}")
    if status.isolated != [name]:
        failures.append(f"{status.isolated} are set aside, not {name}")
    if [fault.joint for fault in status.faults] != [name]:
        failures.append(f"{name} was not named alone: {[fault.cause for fault in status.faults]}")
    if (first := observer.first_safe(since_ns)) is not None:
        failures.append(f"the host stopped all joints at tick {first.message.tick}")
    return failures


def _take_back(observer: Observer) -> None:
    """Disarm, and reset: then the joint counts again."""
    for action in ("disarm", "reset"):
        observer.ask(keys.LIFECYCLE, LifecycleRequest(action=action))
    observer.until(
        lambda: observer.status is not None and not observer.status.isolated,
        "the joint is taken back",
        3.0,
    )
