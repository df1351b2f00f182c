"""What a person tells a robot: `snakesim arm`, `disarm`, `clear`, `estop`."""

import getpass
from collections.abc import Callable
from dataclasses import replace

from snakesim_hal import keys
from snakesim_hal.errors import NotConnectedError, RefusedError
from snakesim_hal.messages import Answer, Description, EstopRequest, LifecycleRequest
from snakesim_hal.session import Link, Session, open_session

CONNECT_S = 1.0
ANSWER_S = 5.0
DESCRIPTION_S = 3.0
HAL_EVERYWHERE = f"**/{keys.alive('hal')}"

Say = Callable[[str], None]


def arm(robot: str, backend: str, link: Link, say: Say = print) -> int:
    """Arm a robot, when it is the one that is meant. Raises RefusedError with the reason."""
    link = of_one(link, f"arm {robot} {backend}")
    with open_session(link, CONNECT_S) as session:
        description = _description(session, link)
        wrong = [
            f"{what} here is {there!r}, not {named!r}"
            for what, there, named in (
                ("the robot", description.robot, robot),
                ("the backend", description.backend, backend),
            )
            if there != named
        ]
        if wrong:
            raise RefusedError(
                f"not armed: {'; '.join(wrong)}. Armed is only what is named: "
                f"`snakesim arm {description.robot} {description.backend}`"
            )
        request = LifecycleRequest(action="arm", robot=robot, backend=backend, config_hash=description.config_hash)
        answer = session.ask_politely(keys.LIFECYCLE, request, ANSWER_S)
    return _tell("armed", link, answer, say)


def disarm(link: Link, say: Say = print) -> int:
    """Let the joints go passive; also what is streamed then does not move them."""
    return _lifecycle(LifecycleRequest(action="disarm"), "disarmed", link, say)


def clear(link: Link, say: Say = print) -> int:
    """Forget a fault or an emergency stop. The robot is disarmed then."""
    return _lifecycle(LifecycleRequest(action="clear"), "cleared", link, say)


def estop(link: Link, say: Say = print) -> int:
    """Stop a robot now; every robot on the network when none is named."""
    key = keys.ESTOP if link.namespace is not None else f"**/{keys.ESTOP}"
    stopped: set[str] = set()
    refused = 0
    with open_session(link, CONNECT_S) as session:
        answers = session.ask_all(key, EstopRequest(who=_who()), ANSWER_S)
        here = [link.namespace] if link.namespace is not None else _robots(session)
        for at, answer in answers:
            name = link.namespace or _namespace(at)
            refused += not answer.ok
            stopped.add(name)
            say(f"{name}: {'stopped' if answer.ok else 'NOT STOPPED'}: {answer.reason}")
    silent = [name for name in here if name not in stopped]
    for name in silent:
        say(f"{name}: NO ANSWER: use its own emergency stop")
    if not here and not stopped:
        say(f"no robot on {link.endpoint}")
    return 1 if silent or refused or not stopped else 0


def _lifecycle(request: LifecycleRequest, done: str, link: Link, say: Say) -> int:
    link = of_one(link, request.action)
    with open_session(link, CONNECT_S) as session:
        answer = session.ask_politely(keys.LIFECYCLE, request, ANSWER_S)
    return _tell(done, link, answer, say)


def _tell(done: str, link: Link, answer: Answer, say: Say) -> int:
    if not answer.ok:
        raise RefusedError(f"{link.namespace}: not {done}: {answer.reason}")
    say(f"{link.namespace}: {done}: {answer.reason}")
    return 0


def of_one(link: Link, command: str) -> Link:
    """The link to the one robot that is meant: the one that is named, or the only one there is."""
    if link.namespace is not None:
        return link
    with open_session(link, CONNECT_S) as session:
        robots = _robots(session)
    if not robots:
        raise NotConnectedError(f"no robot on {link.endpoint}; start a run there, or say where with --endpoint")
    if len(robots) > 1:
        raise RefusedError(
            f"several robots are on {link.endpoint}: {', '.join(robots)}; say which one is meant, such as "
            f"`snakesim {command} --namespace {robots[0]}`"
        )
    return replace(link, namespace=robots[0])


def _robots(session: Session) -> list[str]:
    """The namespaces of all robots whose HAL is alive."""
    return [_namespace(key) for key in session.present(HAL_EVERYWHERE)]


def _namespace(key: str) -> str:
    split = keys.split_namespace(key)
    return key if split is None else split[0]


def _description(session: Session, link: Link) -> Description:
    found = session.latest(keys.DESCRIPTION, Description, DESCRIPTION_S)
    if found is None:
        raise NotConnectedError(f"{link.namespace} shows no description on {link.endpoint}; is its HAL host running?")
    return found


def _who() -> str:
    try:
        return getpass.getuser()[:64]
    except (KeyError, OSError):
        return "operator"
