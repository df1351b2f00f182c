"""A stream that control acts on stops: a sensor's, guidance's or navigation's. Every process lives on."""

import time
from collections.abc import Iterator

from snakesim_hal.model.fault_kinds import find_writer
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, JointMode
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import ProcessRobot, recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest

# Where the snake pushes for as long as it takes.
ALONG_PEGS = {"scene": "peg_row", "mission__speed_m_s": 0.2}
PUSHES = 5  # ticks in a row with a joint in torque mode, before a stream is cut
AWAY_S = 0.5  # from when the controller holds until the stream is back
BACK_S = 5.0  # at most, until it pushes again
DEPTH = 4096


def no_joints(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """The value: until the stop mode. Somebody resets and arms when the stream is back."""
    with robot(request) as (started_robot, observer):
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            requested_ns = _cut(observer, keys.JOINTS)
            value = observer.safe_after_ms(requested_ns)
            status = observer.first_fault(requested_ns)
            failures: list[str] = []
            if [fault.what for fault in status.faults] != ["lease_expired"]:
                failures.append(f"not because of the lease: {status.reason}")
            if status.lease_holder is not None:
                failures.append(f"the lease is still {status.lease_holder}'s")
            _mend(observer, keys.JOINTS)
            yield recovered(observer, value, "; ".join(failures))


def withheld(key: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """The value: from the request to the injector to the last setpoints with which a joint pushed."""
    with robot(request, **ALONG_PEGS) as (started_robot, observer):
        states = observer.session.declare_reader(keys.CONTROL_STATE, ControlState, depth=DEPTH)
        back_ms: list[float] = []
        for _ in range(request.trials):
            _pushing(started_robot, observer)
            states.drain()
            requested_ns = _cut(observer, key)
            observer.until(
                lambda: _named(states.drain(), key), f"{key} named in control/state", BACK_S
            )
            observer.watch(AWAY_S)
            value, failures = _held(observer, requested_ns)
            yield _back(observer, key, value, failures, back_ms)
        request.note(
            "along `peg_row` at 0.2 m/s; until the first setpoints with which no joint pushes, nor does again "
            f"while the stream is away, for {AWAY_S:g} s more"
        )
        request.note(
            f"goes on by itself: a joint pushes again {min(back_ms):.0f} to {max(back_ms):.0f} ms "
            "after the stream is back"
        )


def _cut(observer: Observer, key: str) -> int:
    """Have a stream's writer lose all of it; when that was asked for, by the monotonic clock."""
    requested_ns = time.monotonic_ns()
    observer.inject(find_writer(key), "drop", key)
    return requested_ns


def _mend(observer: Observer, key: str) -> None:
    observer.inject(find_writer(key), "drop", key, end=True)


def _pushing(started_robot: ProcessRobot, observer: Observer) -> None:
    """Armed, and some joint has pushed for a moment."""
    started_robot.set_in_motion(observer)

    def pushes() -> bool:
        newest = observer.applied[-PUSHES:]
        return len(newest) == PUSHES and all(JointMode.TORQUE in h.message.mode for h in newest)

    observer.until(pushes, "a joint that pushes", BACK_S)
    observer.forget()


def _named(states: list[ControlState], key: str) -> bool:
    return any(key in state.reason and state.state == "NotLocomoting" for state in states)


def _held(observer: Observer, requested_ns: int) -> tuple[float | None, list[str]]:
    """When the push ended for good, in ms, and what else is not as it must be."""
    failures: list[str] = []
    if observer.state() != "armed" or observer.first_safe(requested_ns) is not None:
        failures.append(f"the robot stopped: {observer.in_words()}")
    since = [h for h in observer.applied if h.at_ns >= requested_ns]
    pushing = [i for i, h in enumerate(since) if JointMode.TORQUE in h.message.mode]
    last = pushing[-1] if pushing else -1
    if last + 1 >= len(since):
        return None, [*failures, "a joint pushes on"]
    if any(set(h.message.mode) != {JointMode.POSITION} for h in since[last + 1 :]):
        failures.append("not all joints hold their position")
    return (since[last + 1].at_ns - requested_ns) / 1e6, failures


def _back(
    observer: Observer, key: str, value: float | None, failures: list[str], back_ms: list[float]
) -> InjectionTrial:
    """Let the stream come again: the controller pushes by itself, and no target jumps."""
    observer.forget()
    began_ns = time.monotonic_ns()
    _mend(observer, key)

    def pushing() -> list[int]:
        return [h.at_ns for h in observer.applied if JointMode.TORQUE in h.message.mode]

    try:
        back_ns = observer.until(pushing, "a joint pushes again", BACK_S)[0]
    except TrialError as error:
        return InjectionTrial(
            value=value, failure="; ".join([*failures, str(error)]), recovered=False
        )
    back_ms.append((back_ns - began_ns) / 1e6)
    return InjectionTrial(
        value=value, failure="; ".join(failures), recovered=True, **observer.steps()
    )
