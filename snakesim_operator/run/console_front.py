"""Starts the front server of a console, the process that browsers connect to."""

from collections.abc import Callable

from snakesim_hal.network.session import Link
from snakesim_operator.base.console_port import TOKEN_VARIABLE, ConsolePorts
from snakesim_operator.run import children

FRONT = "snakesim_operator.features.console.front"


def start_front(ports: ConsolePorts, link: Link | None, keep: Callable[[bytes], object]) -> children.Child:
    """Start the front server.

    Args:
        ports: Where it listens, and where it finds the page server.
        link: How it reaches the robot that its stop is for; None for a recording.
        keep: Gets what it prints, in another thread.
    """
    handle = ports.browsers.fileno()
    arguments = [FRONT, "--browsers", str(handle), "--pages", str(ports.pages_path), *_describe_robot(link)]
    token = {TOKEN_VARIABLE: ports.token}
    return children.start_child("console front", arguments, keep, inherits=[handle], more=token)


def _describe_robot(link: Link | None) -> list[str]:
    """Return the arguments by which the front server finds the robot."""
    if link is None:
        return ["--recording"]
    robot = [] if link.namespace is None else ["--namespace", link.namespace]
    if link.session is not None:
        return ["--session", str(link.session.path), *robot]
    return ["--endpoint", link.endpoint, *robot]
