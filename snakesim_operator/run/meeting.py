"""Chooses the endpoint of a run, which no other run can have, and opens the run's stop port."""

import contextlib
import socket

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.network.endpoint import DEFAULT_PORT, check_loopback
from snakesim_hal.network.free_ports import LOOPBACK, find_free_port, is_tcp_port_free
from snakesim_hal.network.session import Link, open_session
from snakesim_hal.network.stop_port import open_stop_port, stop_address
from snakesim_hal.wire import keys
from snakesim_operator.base.targets import CONNECT_S, robots_on

MAX_ATTEMPTS = 10  # with ports that were free a moment ago


def meeting_point(endpoint: str | None, lab: Link | None, namespace: str) -> tuple[Link, socket.socket]:
    """Choose the endpoint at which the processes of a run connect, and open the stop port there.

    The caller keeps the stop port bound until the run is over. So two runs that start at the same moment cannot get the
    same endpoint: a port has one holder.

    Args:
        endpoint: on the loopback interface; None: the default port, or any other if that is in use.
        lab: the router of a lab to connect to instead; None: the run has a router of its own.
        namespace: of the robot.

    Returns:
        The link to the endpoint, and the open stop port.

    Raises:
        NotConnectedError: no port is free.
        RefusedError: the loopback interface is down.
    """
    if lab is not None:
        host, port = stop_address(lab.endpoint, listens=False)
        return lab, open_stop_port(host, port)
    check_loopback(endpoint or f"tcp/{LOOPBACK}:{DEFAULT_PORT}")
    if endpoint is not None:
        host, port = stop_address(endpoint, listens=True)
        return Link(endpoint, namespace), open_stop_port(host, port)
    for attempt in range(1 + MAX_ATTEMPTS):
        port = DEFAULT_PORT if attempt == 0 else find_free_port()
        try:
            stop_port = open_stop_port(LOOPBACK, port)
        except NotConnectedError:
            continue
        if is_tcp_port_free(port):
            return Link(f"tcp/{LOOPBACK}:{port}", namespace), stop_port
        stop_port.close()
    raise NotConnectedError("no free port on the loopback interface", code="network/port-in-use")


def refuse_second_robot(endpoint: str | None, lab: Link | None) -> None:
    """Check that no other robot has the name, or the endpoint, of the run that begins.

    Args:
        endpoint: on the loopback interface, as the user gave it; None: any.
        lab: the router of a lab to connect to; None: the run has a router of its own.

    Raises:
        RefusedError: another robot is there.
        NotConnectedError: there is no such router.
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
            others = ", ".join(robots_on(session)) or "another host"
            raise RefusedError(
                f"{others} is on {endpoint} already; end that run first, choose another --endpoint, or join it by "
                f"--router {endpoint} with another --namespace",
                code="robot/already-running",
            )
