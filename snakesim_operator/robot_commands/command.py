"""Commands to a robot: `snakesim robot arm`, `disarm`, `reset`, `sim`.

A name is not an identity: any client on the network can answer in a robot's name. So all hosts are queried, two answers
are an error, and an answer is accepted once the robot's host publishes the new state itself.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.base.terminal import PrintLine, print_line
from snakesim_hal.host.latch import find_latched_stops, remove_latched_stop
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Answer,
    LifecycleRequest,
    RobotDescription,
    RobotStatus,
    SimulatorRequest,
    make_arm_request,
)
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, RobotSelection, find_single_robot
from snakesim_operator.robot_commands.simulator_order import SimulatorOrder

ANSWER_TIMEOUT_S = 5.0
DESCRIPTION_TIMEOUT_S = 3.0
RETRY_PERIOD_S = 0.5  # between two attempts to arm
STATUS_TIMEOUT_S = 1.5  # until the host's status must show what it answered
DONE_TEXT_BY_ACTION = {
    "pause": "paused",
    "resume": "resumed",
    "step": "stepped",
    "speed": "changed",
    "reset": "reset",
}


class ResponseVerification(NamedTuple):
    """Whether the answers to a request come from the robot's host."""

    problem: str | None  # why the answers are not confirmed; None if they are
    status: RobotStatus | None  # newest status of the robot's host; None if there is none


class NotReadyError(RefusedError):
    """The robot cannot be armed now, for a reason that can pass without an operator: a service is still starting."""


def arm_robot(
    robot: str,
    backend: str,
    selection: RobotSelection,
    print_text: PrintLine = print_line,
    *,
    unchecked: bool = False,
    wait_s: float = 0.0,
) -> int:
    """Arm a robot, if its name and its backend are those that the operator names.

    Args:
        robot: Expected name of the robot.
        backend: Expected backend of the robot.
        selection: Selects the robot's network.
        print_text: Prints a line for the operator.
        unchecked: Whether to arm the robot even if its joints were not checked.
        wait_s: Time in which to try again while no robot answers, or while it is not ready. Other refusals end the
            wait, because only an operator can remove their cause.

    Returns:
        0, the exit code of the command.

    Raises:
        NotReadyError: The robot is not ready, at the end of the wait.
        RefusedError: Another robot or backend is there, or the host refuses.
        NotConnectedError: No robot answers, at the end of the wait.
    """
    deadline_s = time.monotonic() + wait_s
    last_reported_problem = ""
    while True:
        try:
            return _arm_once(robot, backend, selection, print_text, unchecked=unchecked)
        except (NotReadyError, NotConnectedError) as error:
            if time.monotonic() >= deadline_s:
                raise
            if str(error) != last_reported_problem:
                last_reported_problem = str(error)
                print_text(f"waiting: {last_reported_problem}")
        time.sleep(RETRY_PERIOD_S)


def _arm_once(
    robot: str, backend: str, selection: RobotSelection, print_text: PrintLine, *, unchecked: bool
) -> int:
    """Send one request to arm a robot, if its name and its backend are those that the user typed.

    Args:
        robot: Name of the robot, as the user typed it.
        backend: Name of the backend, as the user typed it.
        selection: Selects the robot's network.
        print_text: Prints a line for the operator.
        unchecked: Whether to arm the robot even if its joints were not checked.

    Returns:
        0, the exit code of the command.

    Raises:
        NotReadyError: The robot is not ready yet.
        RefusedError: The robot or the backend has another name, or the host refuses.
        NotConnectedError: No robot answers.
    """
    link = find_single_robot(selection, f"robot arm {robot} {backend}")
    with open_session(link, CONNECT_TIMEOUT_S) as session:
        description = _read_description(session, link)
        mismatches: list[str] = []
        if description.robot != robot:
            mismatches.append(f"the robot here is {description.robot!r}, not {robot!r}")
        if description.backend != backend:
            mismatches.append(f"the backend here is {description.backend!r}, not {backend!r}")
        if mismatches:
            raise RefusedError(
                f"not armed: {'; '.join(mismatches)}. To arm, name robot and backend: "
                f"`snakesim robot arm {description.robot} {description.backend}`",
                code="robot/wrong-robot",
            )
        request = make_arm_request(description, get_user_name(), unchecked=unchecked)
        return request_from_host(session, keys.LIFECYCLE, request, "armed", link, print_text)


def disarm_robot(selection: RobotSelection, print_text: PrintLine = print_line) -> int:
    """Disarm a robot: its joints become passive, and later commands do not move them.

    Args:
        selection: Selects the robot.
        print_text: Prints a line for the operator.

    Returns:
        0, the exit code of the command.
    """
    request = LifecycleRequest(action="disarm", requester=get_user_name())
    return _request_from_robot(
        find_single_robot(selection, "robot disarm"),
        keys.LIFECYCLE,
        request,
        "disarmed",
        print_text,
    )


def reset_robot(selection: RobotSelection, print_text: PrintLine = print_line) -> int:
    """Reset a fault or an emergency stop of a robot, which is disarmed afterwards.

    If no robot runs, an emergency stop that the last run on this computer has stored is removed instead.

    Args:
        selection: Selects the robot.
        print_text: Prints a line for the operator.

    Returns:
        0, the exit code of the command.

    Raises:
        NotConnectedError: No robot answers, and no emergency stop is stored.
        RefusedError: The host refuses, or its status does not confirm the reset.
    """
    try:
        link = find_single_robot(selection, "robot reset")
    except NotConnectedError:
        latched_stops = [
            path for path in find_latched_stops() if selection.namespace in (None, path.parent.name)
        ]
        if not latched_stops or selection.endpoint is not None:
            raise
        for path in latched_stops:
            print_text(
                f"{path.parent.name}: {remove_latched_stop(path)}; reset by {get_user_name()}. No robot of "
                "that name runs here"
            )
        return 0
    return _request_from_robot(
        link,
        keys.LIFECYCLE,
        LifecycleRequest(action="reset", requester=get_user_name()),
        "reset",
        print_text,
    )


def control_simulator(
    order: SimulatorOrder, selection: RobotSelection, print_text: PrintLine = print_line
) -> int:
    """Pause, resume, step or reset a simulator, or change its speed. A robot that moves real hardware refuses.

    Args:
        order: Action for the simulator, with its value.
        selection: Selects the robot.
        print_text: Prints a line for the operator.

    Returns:
        0, the exit code of the command.
    """
    request = SimulatorRequest(
        action=order.action,
        requester=order.requester or get_user_name(),
        ticks=order.ticks,
        speed=order.speed,
    )
    return _request_from_robot(
        find_single_robot(selection, f"sim {order}"),
        keys.SIMULATOR,
        request,
        DONE_TEXT_BY_ACTION[order.action],
        print_text,
    )


def _request_from_robot(
    connection: ConnectionSettings,
    key: str,
    request: LifecycleRequest | SimulatorRequest,
    done_text: str,
    print_text: PrintLine,
) -> int:
    with open_session(connection, CONNECT_TIMEOUT_S) as session:
        return request_from_host(session, key, request, done_text, connection, print_text)


def request_from_host(
    session: Session,
    key: str,
    request: LifecycleRequest | SimulatorRequest,
    done_text: str,
    connection: ConnectionSettings,
    print_text: PrintLine,
) -> int:
    """Send a request to the robot's host, confirm the answer by the robot's status, and print it.

    Args:
        session: Session on the robot's network.
        key: Key at which the host answers.
        request: The request.
        done_text: What is done if the host accepts, in words, such as "armed".
        connection: How the session reaches the robot, for messages.
        print_text: Prints a line for the operator.

    Returns:
        0, the exit code of the command.

    Raises:
        NotConnectedError: No host answers.
        RefusedError: The host refuses, or the status does not confirm the answer.
    """
    status_reader = session.declare_latched_reader(keys.STATUS, RobotStatus)
    answers = [answer for _, answer in session.send_request_to_all(key, request, ANSWER_TIMEOUT_S)]
    verification = verify_answers(answers, status_reader)
    name = connection.namespace
    if not answers:
        raise NotConnectedError(
            f"{name}: NO ANSWER on {connection.endpoint}: its host hangs, or your role may not do this; if the "
            "robot moves, `snakesim estop`"
        )
    if verification.problem is not None:
        status = verification.status
        status_text = "unknown" if status is None else f"{status.lifecycle} - {status.reason}"
        raise RefusedError(
            f"{name}: NOT CONFIRMED that it is {done_text}: {verification.problem}. Its status: {status_text}",
            code="robot/not-confirmed",
        )
    answer = answers[0]
    if not answer.ok:
        error_type = NotReadyError if answer.refusal == "not_ready" else RefusedError
        raise error_type(f"{name}: not {done_text}: {answer.reason}")
    print_text(f"{name}: {done_text}: {answer.reason}")
    return 0


def request_while_commanding(
    session: Session,
    request: LifecycleRequest,
    success_message: str,
    connection: ConnectionSettings,
    send_commands: Callable[[], object],
) -> None:
    """Send a request to the robot's host, and keep commanding the robot until the host has answered.

    An armed robot that gets no commands loses its lease (the permission to command), and stops. So another thread
    sends the request meanwhile.

    Args:
        session: Session on the robot's network.
        request: The request to the host.
        success_message: What the host has done once it accepts, in words, such as "armed".
        connection: How the session reaches the robot, for error messages.
        send_commands: Sends commands for a short time, and returns; called until the host has answered.

    Raises:
        NotConnectedError: No host answers.
        RefusedError: The host refuses, or the status does not confirm the response.
    """
    with ThreadPoolExecutor(1) as pool:
        response = pool.submit(
            request_from_host,
            session,
            keys.LIFECYCLE,
            request,
            success_message,
            connection,
            print_text=lambda _line: None,
        )
        while not response.done():
            send_commands()
        response.result()


def verify_answers(
    answers: Sequence[Answer], status_reader: SampleReader[RobotStatus]
) -> ResponseVerification:
    """Check whether the robot's status confirms the answer of its host.

    An unauthorized process may answer in the host's name, or the host may answer and then hang. This waits up to
    STATUS_TIMEOUT_S for a status that confirms the answer.

    Args:
        answers: All answers to one request. Without an answer, there is nothing to confirm: that is a problem, too.
        status_reader: Reads the status that the robot's host publishes.

    Returns:
        The problem, which is None if exactly one host answered and its status confirms the answer, and the newest
        status.
    """
    if len(answers) > 1:
        status = _wait_for_status(status_reader, None)
        return ResponseVerification(
            f"{len(answers)} answered in its name; at least one is an impostor", status
        )
    answered_lifecycle = answers[0].lifecycle if answers else None
    status = _wait_for_status(status_reader, answered_lifecycle)
    host_ids = {answer.host for answer in answers}
    if status is not None:
        host_ids.add(status.host)
    if len(host_ids) > 1:
        problem = (
            "the answer is not from the host that publishes its status; one of them is an impostor"
        )
        return ResponseVerification(problem, status)
    if status is None or status.lifecycle != answered_lifecycle:
        problem = (
            "its status does not show it; the host may hang, and the answer be from an impostor"
        )
        return ResponseVerification(problem, status)
    return ResponseVerification(None, status)


def _wait_for_status(
    status_reader: SampleReader[RobotStatus], expected_lifecycle: str | None
) -> RobotStatus | None:
    """Wait up to STATUS_TIMEOUT_S for a status with the expected lifecycle state.

    Args:
        status_reader: Reads the status that the robot's host publishes.
        expected_lifecycle: The expected state. If None, any status ends the wait.

    Returns:
        The newest status, which may have another state; None if there was no status.
    """
    newest_status: RobotStatus | None = None
    deadline_s = time.monotonic() + STATUS_TIMEOUT_S
    while time.monotonic() < deadline_s:
        new_statuses = status_reader.drain()
        if new_statuses:
            newest_status = new_statuses[-1]
        if newest_status is not None and expected_lifecycle in (None, newest_status.lifecycle):
            break
        time.sleep(0.01)
    return newest_status


def _read_description(session: Session, connection: ConnectionSettings) -> RobotDescription:
    """Wait for the description that the host of a robot publishes, and check that there is only one host.

    Args:
        session: Session on the robot's network.
        connection: How to reach the robot, for messages.

    Raises:
        NotConnectedError: No host publishes a description.
        RefusedError: Several hosts publish one.
    """
    reader = session.declare_latched_reader(keys.DESCRIPTION, RobotDescription)
    deadline_s = time.monotonic() + DESCRIPTION_TIMEOUT_S
    descriptions: list[RobotDescription] = []
    while not descriptions and time.monotonic() < deadline_s:
        time.sleep(0.05)
        descriptions = reader.drain()
    if not descriptions:
        raise NotConnectedError(
            f"{connection.namespace} publishes no description on {connection.endpoint}; is its HAL host running?",
            code="network/no-robot",
        )
    if len({description.host for description in descriptions}) > 1:
        host_count = len(descriptions)
        raise RefusedError(
            f"{connection.namespace}: {host_count} hosts describe it; at least one is an impostor. Not armed",
            code="robot/several-hosts",
        )
    return descriptions[-1]
