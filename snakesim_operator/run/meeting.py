"""The endpoint of a run, which no other run can have, and its stop port."""

import contextlib
import socket

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.network.endpoint import DEFAULT_PORT, check_loopback
from snakesim_hal.network.session import Link, open_session
from snakesim_hal.network.stop_port import open_stop_port, stop_address
from snakesim_hal.wire import keys
from snakesim_operator.base.targets import CONNECT_S, robots_on

LOOPBACK = "127.0.0.1"
TRIES = 10


def meeting_point(endpoint: str | None, lab: Link | None, namespace: str) -> tuple[Link, socket.socket]:
    """Where the run's parts meet, and its stop port, which this process keeps bound until the run is over.

    Two runs that start at the same moment cannot get the same endpoint, because a port has one holder. Without
    `endpoint` it is the default port, or any other if that is in use.

    Raises:
        NotConnectedError: no port is free.
        RefusedError: the loopback interface is down.
    """
    if lab is not None:
        return lab, open_stop_port(*stop_address(lab.endpoint, listens=False))
    check_loopback(endpoint or f"tcp/{LOOPBACK}:{DEFAULT_PORT}")
    if endpoint is not None:
        stop_port = open_stop_port(*stop_address(endpoint, listens=True))
        return Link(endpoint, namespace), stop_port
    for wanted in (DEFAULT_PORT, *[0] * TRIES):
        with contextlib.suppress(NotConnectedError):
            stop_port = open_stop_port(LOOPBACK, wanted)
            port: int = stop_port.getsockname()[1]
            if _is_free(port):
                return Link(f"tcp/{LOOPBACK}:{port}", namespace), stop_port
            stop_port.close()
    raise NotConnectedError("no free port on the loopback interface", code="network/port-in-use")


def refuse_second_robot(endpoint: str | None, lab: Link | None) -> None:
    """Raise RefusedError when there is a robot already: two would have one name, or share an endpoint.

    Raises NotConnectedError when there is no such router.
    """
    if lab is not None:
        with open_session(lab, CONNECT_S) as session:
            if session.present(keys.alive_key("hal")) or session.present(keys.HOST_ALL):
                raise RefusedError(
                    f"{lab.namespace} is on {lab.endpoint} already; end that run first, or give this one another "
                    f"--namespace",
                    code="robot/already-running",
                )
    elif endpoint is not None:
        with contextlib.suppress(NotConnectedError), open_session(Link(endpoint), CONNECT_S) as session:
            there = ", ".join(robots_on(session)) or "another host"
            raise RefusedError(
                f"{there} is on {endpoint} already; end that run first, choose another --endpoint, or join it by "
                f"--router {endpoint} with another --namespace",
                code="robot/already-running",
            )


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
    return True
