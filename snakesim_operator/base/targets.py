"""Searching the robots that a command addresses."""

import contextlib
import shlex
from dataclasses import replace

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.base.robot_selection import RobotSelection

CONNECT_S = 1.0
SEARCH_S = 3.0  # to connect, and to answer: a busy computer takes more than a second, and its robot is there
HAL_EVERYWHERE = f"**/{keys.alive_key('hal')}"


def flags_of(link: Link, robot: str | None) -> str:
    """What to type after a command to address a robot; nothing for a default. robot: its own name."""
    where = f" --endpoint {link.endpoint}" if link.endpoint != DEFAULT_ENDPOINT else ""
    if link.session is not None:
        where = f" --session {shlex.quote(str(link.session.path))}"
    return where + (f" --namespace {link.namespace}" if link.namespace != robot else "")


def robots_on(session: Session) -> list[str]:
    """Return the namespaces of all robots whose HAL is alive on a network."""
    return [namespace_of(key) for key in session.present(HAL_EVERYWHERE, SEARCH_S)]


def namespace_of(key: str) -> str:
    """Return the namespace of a full key, or the key itself if it has none."""
    namespace_and_key = keys.split_namespace(key)
    if namespace_and_key is None:
        return key
    return namespace_and_key[0]


def find_robots(where: RobotSelection) -> list[Link]:
    """Return every addressed robot that can be reached."""
    links: list[Link] = []
    for link in where.networks():
        try:
            with open_session(link, SEARCH_S) as session:
                if link.namespace is None:
                    links += [replace(link, namespace=name) for name in robots_on(session)]
                elif session.present(keys.alive_key("hal"), SEARCH_S):
                    links.append(link)
        except NotConnectedError:
            continue
    return links


def sessions_on(where: RobotSelection, opened: contextlib.ExitStack) -> list[tuple[Link, Session]]:
    """Open a session on every network that answers, for messages of any size. Raises NotConnectedError without one."""
    sessions: list[tuple[Link, Session]] = []
    for link in where.networks():
        with contextlib.suppress(NotConnectedError):
            whole = replace(link, max_bytes=MAX_IMAGE_BYTES)
            sessions.append((link, opened.enter_context(open_session(whole, CONNECT_S))))
    if not sessions:
        raise NotConnectedError(
            f"nothing listens on {', '.join(where.endpoints())}; start a run or a router there first",
            code="network/nothing-listens",
        )
    return sessions


def only_robot(where: RobotSelection, command: str) -> Link:
    """Return the single addressed robot. Raises NotConnectedError for none, RefusedError for more than one."""
    found = find_robots(where)
    if not found:
        named = "" if where.namespace is None else f" named {where.namespace}"
        raise NotConnectedError(
            f"no robot{named} on {', '.join(where.endpoints())}; start a run there, or give --endpoint",
            code="network/no-robot",
        )
    if len(found) > 1:
        choices = [f"  snakesim {command}{flags_of(link, None)}" for link in found]
        raise RefusedError("several robots found; choose one:", *choices, code="network/several-robots")
    return found[0]
