"""`snakesim estop`: stop a robot now, or without a name every reachable one.

Two ways at once, until one is answered or five seconds have passed: each robot's stop port, which floods and full
sessions do not block, and the network, for robots behind a lab's router.
"""

import socket
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from snakesim_hal.errors import NotConnectedError
from snakesim_hal.network.process_entries import who
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.stop_port import ask_to_stop, stop_address
from snakesim_hal.terminal import Say, say
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, EstopRequest, Status
from snakesim_operator.tools.command import judge
from snakesim_operator.tools.targets import CONNECT_S, Where, namespace_of, robots_on

LIMIT_S = 5.0
ASK_S = 1.0


@dataclass(frozen=True)
class Told:
    """The result for one robot."""

    name: str
    endpoint: str
    stopped: bool
    text: str
    in_doubt: bool = False  # an impostor may answer in its name


def estop(where: Where, say: Say = say) -> int:
    """Stop them. Returns 0 when every known robot has confirmed that it is stopped."""
    local = {(robot.stop_host, robot.stop_port): Link(robot.endpoint, robot.namespace) for robot in where.local()}
    elsewhere: dict[tuple[str, int], Link] = {}
    if where.endpoint is not None and not local and (address := stop_address(where.endpoint, listens=True))[1]:
        elsewhere[address] = Link(where.endpoint, where.namespace)
    networks = where.networks()
    with ThreadPoolExecutor(len(local) + len(elsewhere) + len(networks)) as side_by_side:
        asked_here = [side_by_side.submit(_at_port, link, *address) for address, link in local.items()]
        asked_there = [side_by_side.submit(_at_port, link, *address) for address, link in elsewhere.items()]
        asked_all = [side_by_side.submit(_on_network, link) for link in networks]
        here = [told for future in asked_here if (told := future.result()) is not None]
        there = [told for future in asked_there if (told := future.result()) is not None]
        shown = [told for future in asked_all for told in future.result()]
    told = [*here, *_confirmed(there, shown), *_others(here, there, shown)]
    for robot in told:
        say(f"{robot.name}: {'stopped' if robot.stopped else 'NOT STOPPED'}: {robot.text} ({robot.endpoint})")
    for robot in shown:
        if robot.in_doubt and any(_same(robot, other) for other in here):
            say(f"{robot.name}: WARNING: {robot.text} ({robot.endpoint})")
    if not told:
        say(f"no robot on {', '.join(where.endpoints())}, and none that this user runs on this computer")
    return 0 if told and all(robot.stopped for robot in told) else 1


def _confirmed(there: list[Told], shown: list[Told]) -> list[Told]:
    """Answers of stop ports of other computers, once the robot's network confirms them: such a port may be forged."""
    return [
        told
        if not told.stopped or any(_same(told, other) and other.stopped for other in shown)
        else replace(
            told, stopped=False, text=f"its stop port reports it, but nothing on its network confirms it: {told.text}"
        )
        for told in there
    ]


def _others(here: list[Told], there: list[Told], shown: list[Told]) -> list[Told]:
    """Robots that only the network reports."""
    return [told for told in shown if not any(_same(told, other) for other in (*here, *there))]


def _same(a: Told, b: Told) -> bool:
    return (a.endpoint, a.name) == (b.endpoint, b.name)


def _at_port(link: Link, host: str, port: int) -> Told | None:
    """Send a stop to a stop port; None when the port is closed."""
    try:
        answer = ask_to_stop(host, port, who(), LIMIT_S)
    except NotConnectedError:
        return None
    if answer is not None:
        return Told(answer.robot, link.endpoint, stopped=True, text=answer.text)
    text = f"NO ANSWER at udp/{host}:{port} for {LIMIT_S:g} s: use its own emergency stop"
    return Told(link.namespace or "a robot", link.endpoint, stopped=False, text=text)


def _on_network(link: Link) -> list[Told]:
    """Query all hosts on a network, repeatedly while none can be reached."""
    deadline = time.monotonic() + LIMIT_S
    while True:
        try:
            with open_session(link, CONNECT_S) as session:
                return _ask(session, link)
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


def _ask(session: Session, link: Link) -> list[Told]:
    names = [link.namespace] if link.namespace is not None else robots_on(session)
    prefix = "" if link.namespace is not None else "**/"
    answers: dict[str, list[Answer]] = {}
    statuses = {name: session.latched_reader(_of(name, link, keys.STATUS), Status) for name in names}
    deadline = time.monotonic() + LIMIT_S
    while not answers and time.monotonic() < deadline:
        for key, answer in session.ask_all(f"{prefix}{keys.ESTOP}", EstopRequest(who=who()), ASK_S):
            answers.setdefault(link.namespace or namespace_of(key), []).append(answer)
        if not names:
            break
    told: list[Told] = []
    for name in dict.fromkeys([*names, *answers]):
        given = answers.get(name, [])
        if not given:
            told.append(
                Told(
                    name, link.endpoint, stopped=False, text=f"NO ANSWER for {LIMIT_S:g} s: use its own emergency stop"
                )
            )
            continue
        reader = statuses.get(name) or session.latched_reader(_of(name, link, keys.STATUS), Status)
        doubt, _ = judge(given, reader)
        refused = next((answer.reason for answer in given if not answer.ok), None)
        wrong = doubt or refused
        told.append(
            Told(name, link.endpoint, stopped=wrong is None, text=wrong or given[0].reason, in_doubt=doubt is not None)
        )
    return told


def _of(name: str, link: Link, key: str) -> str:
    return key if link.namespace is not None else f"{name}/{key}"
