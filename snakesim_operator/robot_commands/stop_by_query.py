"""Emergency stops by queries on the network, for robots that only a router reaches."""

import socket
import time

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.base.process import user_name
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.stop_port import stop_address
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, EstopRequest, Status
from snakesim_operator.base.targets import CONNECT_S, namespace_of, robots_on
from snakesim_operator.robot_commands.command import judge
from snakesim_operator.robot_commands.stop_result import StopResult

ASK_S = 1.0


def ask_network(link: Link, limit_s: float) -> list[StopResult]:
    """Query all hosts on a network, repeatedly while none can be reached."""
    deadline = time.monotonic() + limit_s
    while True:
        try:
            with open_session(link, CONNECT_S) as session:
                return ask_session(session, link, limit_s)
        except NotConnectedError:
            if time.monotonic() > deadline or not _anybody(link):
                return []


def _anybody(link: Link) -> bool:
    """Whether anything listens at the endpoint, even if it accepts no session."""
    host, port = stop_address(link.endpoint, listens=True)
    try:
        with socket.create_connection((host, port), timeout=ASK_S):
            return bool(port)
    except OSError:
        return False


def ask_session(session: Session, link: Link, limit_s: float) -> list[StopResult]:
    """Query all hosts over an open session; what it subscribes to stays subscribed until that session is closed."""
    names = [link.namespace] if link.namespace is not None else robots_on(session)
    prefix = "" if link.namespace is not None else "**/"
    answers: dict[str, list[Answer]] = {}
    statuses = {name: session.latched_reader(_of(name, link, keys.STATUS), Status) for name in names}
    deadline = time.monotonic() + limit_s
    while not answers and time.monotonic() < deadline:
        for key, answer in session.ask_all(f"{prefix}{keys.ESTOP}", EstopRequest(who=user_name()), ASK_S):
            answers.setdefault(link.namespace or namespace_of(key), []).append(answer)
        if not names:
            break
    results: list[StopResult] = []
    for name in dict.fromkeys([*names, *answers]):
        given = answers.get(name, [])
        if not given:
            text = f"NO ANSWER for {limit_s:g} s: use its own emergency stop"
            results.append(StopResult(name, link.endpoint, stopped=False, text=text))
            continue
        reader = statuses.get(name) or session.latched_reader(_of(name, link, keys.STATUS), Status)
        doubt, _ = judge(given, reader)
        refused = next((answer.reason for answer in given if not answer.ok), None)
        wrong = doubt or refused
        text, in_doubt = wrong or given[0].reason, doubt is not None
        results.append(StopResult(name, link.endpoint, stopped=wrong is None, text=text, in_doubt=in_doubt))
    return results


def _of(name: str, link: Link, key: str) -> str:
    return key if link.namespace is not None else f"{name}/{key}"
