"""Emergency stops by queries on the network, for robots that only a router reaches."""

import socket
import time

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.stop_port import stop_address
from snakesim_hal.network.streams import Reader
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, EstopRequest, Status
from snakesim_operator.base.targets import CONNECT_S, namespace_of, robots_on
from snakesim_operator.robot_commands.command import judge
from snakesim_operator.robot_commands.stop_result import StopResult

ASK_S = 1.0  # for the answers to one query


def ask_network(link: Link, limit_s: float) -> list[StopResult]:
    """Query all hosts on a network, repeatedly while the network cannot be reached.

    Args:
        link: how to connect; with a namespace only that robot's host is queried.
        limit_s: time to connect, and then for the answers.
    """
    deadline = time.monotonic() + limit_s
    while True:
        try:
            with open_session(link, CONNECT_S) as session:
                return ask_session(session, link, limit_s)
        except NotConnectedError:
            if time.monotonic() > deadline or not _endpoint_listens(link):
                return []


def _endpoint_listens(link: Link) -> bool:
    """Return whether a program listens at the endpoint, even if it accepts no session."""
    host, port = stop_address(link.endpoint, listens=True)
    try:
        with socket.create_connection((host, port), timeout=ASK_S):
            return bool(port)
    except OSError:
        return False


def ask_session(session: Session, link: Link, limit_s: float) -> list[StopResult]:
    """Query all hosts over an open session, and check their answers by their status.

    The subscriptions stay until the session is closed.
    """
    names = [link.namespace] if link.namespace is not None else robots_on(session)
    statuses = {name: _read_status(session, link, name) for name in names}
    answers = _query_hosts(session, link, limit_s, repeat=bool(names))
    results: list[StopResult] = []
    for name in dict.fromkeys([*names, *answers]):
        if name not in answers:
            text = f"NO ANSWER for {limit_s:g} s: use its own emergency stop"
            results.append(StopResult(name, link.endpoint, stopped=False, text=text))
            continue
        status = statuses.get(name) or _read_status(session, link, name)
        results.append(_check_answers(name, link, answers[name], status))
    return results


def _query_hosts(session: Session, link: Link, limit_s: float, *, repeat: bool) -> dict[str, list[Answer]]:
    """Send the query until a host answers. Returns the answers by name of the robot.

    repeat: whether to query more than once; without any known robot once is enough.
    """
    key = keys.ESTOP if link.namespace is not None else f"**/{keys.ESTOP}"
    answers: dict[str, list[Answer]] = {}
    deadline = time.monotonic() + limit_s
    while not answers and time.monotonic() < deadline:
        for answer_key, answer in session.request_all(key, EstopRequest(requester=get_user_name()), ASK_S):
            name = link.namespace or namespace_of(answer_key)
            answers.setdefault(name, []).append(answer)
        if not repeat:
            break
    return answers


def _check_answers(name: str, link: Link, answers: list[Answer], statuses: Reader[Status]) -> StopResult:
    """Return the result for one robot: stopped only if all answers accept the stop, and its status shows it."""
    doubt, _ = judge(answers, statuses)
    refusal = next((answer.reason for answer in answers if not answer.ok), None)
    problem = doubt or refusal
    return StopResult(
        name,
        link.endpoint,
        stopped=problem is None,
        text=problem or answers[0].reason,
        in_doubt=doubt is not None,
    )


def _read_status(session: Session, link: Link, name: str) -> Reader[Status]:
    """Subscribe to a robot's status."""
    key = keys.STATUS if link.namespace is not None else f"{name}/{keys.STATUS}"
    return session.latched_reader(key, Status)
