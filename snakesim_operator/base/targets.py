"""Finds the robots that a command addresses."""

import contextlib
import shlex
from dataclasses import replace

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.base.robot_selection import RobotSelection

CONNECT_TIMEOUT_S = 1.0
SEARCH_TIMEOUT_S = 3.0  # to connect, and to answer: a busy computer takes more than a second, and its robot is there
ALL_HALS_KEY = f"**/{keys.alive_key('hal')}"


def make_robot_flags(connection: ConnectionSettings, robot: str | None) -> str:
    """Make the command-line flags that address a robot; empty for the defaults.

    Args:
        connection: Link to the robot.
        robot: Name of the robot, which is its default namespace; None to always name the namespace.
    """
    flags = f" --endpoint {connection.endpoint}" if connection.endpoint != DEFAULT_ENDPOINT else ""
    if connection.session is not None:
        flags = f" --session {shlex.quote(str(connection.session.path))}"
    return flags + (f" --namespace {connection.namespace}" if connection.namespace != robot else "")


def find_namespaces(session: Session) -> list[str]:
    """Find the namespaces of all robots whose HAL host is alive on a network."""
    return [get_namespace(key) for key in session.list_tokens(ALL_HALS_KEY, SEARCH_TIMEOUT_S)]


def get_namespace(key: str) -> str:
    """Return the namespace of a full key, or the key itself if it has none."""
    namespace_and_key = keys.split_namespace(key)
    if namespace_and_key is None:
        return key
    return namespace_and_key[0]


def find_robots(selection: RobotSelection) -> list[ConnectionSettings]:
    """Find the links to all addressed robots that can be reached."""
    links: list[ConnectionSettings] = []
    for link in selection.list_networks():
        try:
            with open_session(link, SEARCH_TIMEOUT_S) as session:
                if link.namespace is None:
                    links += [replace(link, namespace=name) for name in find_namespaces(session)]
                elif session.list_tokens(keys.alive_key("hal"), SEARCH_TIMEOUT_S):
                    links.append(link)
        except NotConnectedError:
            continue
    return links


def open_sessions(
    selection: RobotSelection, exit_stack: contextlib.ExitStack
) -> list[tuple[ConnectionSettings, Session]]:
    """Open a session on every network that can be reached, for messages of any size.

    Args:
        selection: The addressed robots.
        exit_stack: Closes the sessions.

    Returns:
        Pairs of link and session.

    Raises:
        NotConnectedError: No network can be reached.
    """
    sessions: list[tuple[ConnectionSettings, Session]] = []
    for link in selection.list_networks():
        with contextlib.suppress(NotConnectedError):
            unlimited_link = replace(link, max_bytes=MAX_IMAGE_BYTES)
            sessions.append(
                (link, exit_stack.enter_context(open_session(unlimited_link, CONNECT_TIMEOUT_S)))
            )
    if not sessions:
        raise NotConnectedError(
            f"nothing listens on {', '.join(selection.list_endpoints())}; start a run or a router there first",
            code="network/nothing-listens",
        )
    return sessions


def find_single_robot(selection: RobotSelection, command: str) -> ConnectionSettings:
    """Find the single addressed robot.

    Args:
        selection: The addressed robots.
        command: Command line of the command, for the message about several robots.

    Returns:
        The link to the robot.

    Raises:
        NotConnectedError: No robot was found.
        RefusedError: Several robots were found.
    """
    links = find_robots(selection)
    if not links:
        named = "" if selection.namespace is None else f" named {selection.namespace}"
        raise NotConnectedError(
            f"no robot{named} on {', '.join(selection.list_endpoints())}; start a run there, or give --endpoint",
            code="network/no-robot",
        )
    if len(links) > 1:
        choices = [f"  snakesim {command}{make_robot_flags(link, None)}" for link in links]
        raise RefusedError(
            "several robots found; choose one:", *choices, code="network/several-robots"
        )
    return links[0]
