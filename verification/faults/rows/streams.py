"""Measures a stream that stops although its process continues: of a sensor, of guidance, or of navigation."""

import time
from collections.abc import Iterator

from snakesim_hal.model.fault_kinds import find_writer
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, ControlState, JointMode
from verification.faults.observer import Observer, ReceivedMessage, TrialError
from verification.faults.robot import ProcessRobot, recover_robot, start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest

# A scene in which the snake pushes against obstacles for as long as it takes.
PEG_ROW = {"scene": "peg_row", "mission__speed_m_s": 0.2}
MIN_PUSHING_TICKS = 5  # in a row, before a stream is cut
CUT_DURATION_S = 0.5  # after the controller has named the missing stream
PUSHING_TIMEOUT_S = 5.0
STATE_BUFFER_SIZE = 4096  # control states


def measure_lost_joint_states(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Lose all joint states while the robot moves. An operator resets and arms when they are back.

    Yields:
        Trials whose value is the time from the request to the stop mode, in ms.
    """
    with start_robot(request) as (robot, observer):
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            request_ns = _cut_stream(observer, keys.JOINTS)
            delay_ms = observer.measure_stop_delay_ms(request_ns)
            status = observer.wait_for_fault(request_ns)
            failures: list[str] = []
            if [fault.what for fault in status.faults] != ["lease_expired"]:
                failures.append(f"not because of the lease: {status.reason}")
            if status.lease_holder is not None:
                failures.append(f"the lease is still {status.lease_holder}'s")
            _restore_stream(observer, keys.JOINTS)
            yield recover_robot(observer, delay_ms, failures)


def measure_lost_stream(key: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Lose all samples of a key while a joint pushes, and check that the controller continues when they are back.

    Yields:
        Trials whose value is the time from the request to the first setpoints with which no joint pushes, in ms.
    """
    with start_robot(request, **PEG_ROW) as (robot, observer):
        states = observer.session.declare_reader(
            keys.CONTROL_STATE, ControlState, depth=STATE_BUFFER_SIZE
        )
        return_delays_ms: list[float] = []
        for _ in range(request.trials):
            _wait_until_pushing(robot, observer)
            states.drain()
            request_ns = _cut_stream(observer, key)
            observer.wait_until(
                lambda: _is_named(states.drain(), key),
                f"{key} named in control/state",
                PUSHING_TIMEOUT_S,
            )
            observer.listen_for(CUT_DURATION_S)
            failures = _check_holding(observer, request_ns)
            delay_ms = _measure_push_end_ms(observer, request_ns)
            if delay_ms is None:
                failures.append("a joint pushes on")
            yield _return_stream(observer, key, delay_ms, failures, return_delays_ms)
        request.add_note(
            "along `peg_row` at 0.2 m/s; until the first setpoints with which no joint pushes, nor does again "
            f"while the stream is away, for {CUT_DURATION_S:g} s more"
        )
        request.add_note(
            f"goes on by itself: a joint pushes again {min(return_delays_ms):.0f} to {max(return_delays_ms):.0f} ms "
            "after the stream is back"
        )


def _cut_stream(observer: Observer, key: str) -> int:
    """Let the writer of a key lose every sample. Return the time of the request, by the monotonic clock in ns."""
    request_ns = time.monotonic_ns()
    observer.inject_fault(find_writer(key), "drop", key)
    return request_ns


def _restore_stream(observer: Observer, key: str) -> None:
    """Let the writer of a key publish again."""
    observer.inject_fault(find_writer(key), "drop", key, end=True)


def _wait_until_pushing(robot: ProcessRobot, observer: Observer) -> None:
    """Arm the robot if necessary, and wait until a joint has pushed for MIN_PUSHING_TICKS."""
    robot.set_in_motion(observer)

    def is_pushing() -> bool:
        newest = observer.applied[-MIN_PUSHING_TICKS:]
        return len(newest) == MIN_PUSHING_TICKS and all(map(_has_pushing_joint, newest))

    observer.wait_until(is_pushing, "a joint that pushes", PUSHING_TIMEOUT_S)
    observer.forget()


def _has_pushing_joint(received: ReceivedMessage[AppliedCommand]) -> bool:
    return JointMode.TORQUE in received.message.mode


def _is_named(states: list[ControlState], key: str) -> bool:
    """Return whether the controller held, and named the key as the reason."""
    return any(state.state == "NotLocomoting" and key in state.reason for state in states)


def _list_setpoints_after_push(
    observer: Observer, since_ns: int
) -> list[ReceivedMessage[AppliedCommand]]:
    """Return the setpoints after a time that follow the last ones with which a joint pushed."""
    setpoints = [received for received in observer.applied if received.at_ns >= since_ns]
    pushing = [i for i, received in enumerate(setpoints) if _has_pushing_joint(received)]
    first = pushing[-1] + 1 if pushing else 0
    return setpoints[first:]


def _measure_push_end_ms(observer: Observer, since_ns: int) -> float | None:
    """Return when the push ended for good after a time, in ms, or None if a joint still pushes."""
    setpoints = _list_setpoints_after_push(observer, since_ns)
    if not setpoints:
        return None
    return (setpoints[0].at_ns - since_ns) / 1e6


def _check_holding(observer: Observer, since_ns: int) -> list[str]:
    """Check that the robot did not stop, and that every joint holds its position once the push has ended.

    Returns:
        A description of each violation.
    """
    failures: list[str] = []
    if observer.get_lifecycle() != "armed" or observer.find_stop_setpoints(since_ns) is not None:
        failures.append(f"the robot stopped: {observer.describe_status()}")
    for received in _list_setpoints_after_push(observer, since_ns):
        if set(received.message.mode) != {JointMode.POSITION}:
            failures.append("not all joints hold their position")
            break
    return failures


def _return_stream(
    observer: Observer,
    key: str,
    delay_ms: float | None,
    failures: list[str],
    return_delays_ms: list[float],
) -> InjectionTrial:
    """Restore a stream, and wait until a joint pushes again without a request of an operator.

    Args:
        observer: Observer of the robot.
        key: Key of the stream.
        delay_ms: Value of the trial.
        failures: What was wrong in the trial so far.
        return_delays_ms: Gets the time from the request to the first setpoints with which a joint pushes.
    """
    observer.forget()
    request_ns = time.monotonic_ns()
    _restore_stream(observer, key)

    def find_push() -> ReceivedMessage[AppliedCommand] | None:
        return next(filter(_has_pushing_joint, observer.applied), None)

    try:
        push = observer.wait_until(find_push, "a joint pushes again", PUSHING_TIMEOUT_S)
    except TrialError as error:
        failures.append(str(error))
        return InjectionTrial(value=delay_ms, failure="; ".join(failures), recovered=False)
    return_delays_ms.append((push.at_ns - request_ns) / 1e6)
    steps = observer.measure_target_steps()
    return InjectionTrial(
        value=delay_ms,
        failure="; ".join(failures),
        recovered=True,
        step_rad=steps.step_rad,
        first_rad=steps.first_rad,
    )
