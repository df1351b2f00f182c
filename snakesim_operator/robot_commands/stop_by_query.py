"""Emergency stops by queries on the network, for robots that only a router reaches."""

import socket
import time

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.stop_port import find_stop_address
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, EstopRequest, RobotStatus
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, find_namespaces, get_namespace
from snakesim_operator.robot_commands.command import verify_answers
from snakesim_operator.robot_commands.stop_result import StopResult

QUERY_TIMEOUT_S = 1.0  # for the answers to one query


def request_stop_on_network(connection: ConnectionSettings, timeout_s: float) -> list[StopResult]:
    """Connect to a network, and stop its robots by queries to their hosts.

    Connecting is repeated while a program listens at the endpoint but accepts no session.

    Args:
        connection: How to connect. With a namespace, only the host of that robot is queried.
        timeout_s: Time to connect, and then again for the answers.

    Returns:
        One result for each robot; empty if the network cannot be reached.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            with open_session(connection, CONNECT_TIMEOUT_S) as session:
                return request_stop_over_session(session, connection, timeout_s)
        except NotConnectedError:
            if time.monotonic() > deadline or not _has_listener(connection):
                return []


def _has_listener(connection: ConnectionSettings) -> bool:
    """Return whether a program listens at the endpoint, even if it accepts no session."""
    host, port = find_stop_address(connection.endpoint, listens=True)
    try:
        with socket.create_connection((host, port), timeout=QUERY_TIMEOUT_S):
            return bool(port)
    except OSError:
        return False


def request_stop_over_session(
    session: Session, connection: ConnectionSettings, timeout_s: float
) -> list[StopResult]:
    """Stop robots by queries to their hosts, and check the answers against the status that the hosts publish.

    The status subscriptions stay until the session is closed.

    Args:
        session: Session on the network of the robots.
        connection: How the session reaches the robots. With a namespace, only the host of that robot is queried.
        timeout_s: Time in which the query is repeated until a host answers.

    Returns:
        One result for each robot that is known or that has answered.
    """
    robot_names = (
        [connection.namespace] if connection.namespace is not None else find_namespaces(session)
    )
    status_reader_by_robot = {
        name: _subscribe_to_status(session, connection, name) for name in robot_names
    }
    answers_by_robot = _request_stop_from_hosts(
        session, connection, timeout_s, should_repeat=bool(robot_names)
    )
    results: list[StopResult] = []
    for name in dict.fromkeys([*robot_names, *answers_by_robot]):
        if name not in answers_by_robot:
            text = f"NO ANSWER for {timeout_s:g} s: use its own emergency stop"
            results.append(StopResult(name, connection.endpoint, is_stopped=False, text=text))
            continue
        status_reader = status_reader_by_robot.get(name) or _subscribe_to_status(
            session, connection, name
        )
        results.append(
            _make_verified_result(name, connection, answers_by_robot[name], status_reader)
        )
    return results


def _request_stop_from_hosts(
    session: Session, connection: ConnectionSettings, timeout_s: float, *, should_repeat: bool
) -> dict[str, list[Answer]]:
    """Send the stop query to the hosts until at least one answers.

    Args:
        session: Session on the network of the robots.
        connection: How the session reaches the robots. With a namespace, only the host of that robot is queried.
        timeout_s: Time in which the query is repeated.
        should_repeat: Whether to query more than once. Without any known robot, once is enough.

    Returns:
        The answers by name of the robot.
    """
    key = keys.ESTOP if connection.namespace is not None else f"**/{keys.ESTOP}"
    answers_by_robot: dict[str, list[Answer]] = {}
    deadline = time.monotonic() + timeout_s
    while not answers_by_robot and time.monotonic() < deadline:
        for answer_key, answer in session.send_request_to_all(
            key, EstopRequest(requester=get_user_name()), QUERY_TIMEOUT_S
        ):
            name = connection.namespace or get_namespace(answer_key)
            answers_by_robot.setdefault(name, []).append(answer)
        if not should_repeat:
            break
    return answers_by_robot


def _make_verified_result(
    name: str,
    connection: ConnectionSettings,
    answers: list[Answer],
    status_reader: SampleReader[RobotStatus],
) -> StopResult:
    """Return the result for one robot, which is stopped only if its status confirms the answer and no host refused.

    Args:
        name: Name of the robot.
        connection: How the robot was reached.
        answers: All answers of hosts with this name.
        status_reader: Reads the status that the robot's host publishes.
    """
    doubt = verify_answers(answers, status_reader).problem
    refusal = next((answer.reason for answer in answers if not answer.ok), None)
    problem = doubt or refusal
    return StopResult(
        name,
        connection.endpoint,
        is_stopped=problem is None,
        text=problem or answers[0].reason,
        is_doubtful=doubt is not None,
    )


def _subscribe_to_status(
    session: Session, connection: ConnectionSettings, name: str
) -> SampleReader[RobotStatus]:
    """Subscribe to the status of one robot, and return the reader."""
    key = keys.STATUS if connection.namespace is not None else f"{name}/{keys.STATUS}"
    return session.declare_latched_reader(key, RobotStatus)
