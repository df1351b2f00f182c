"""Chooses the endpoint of a run, which no other run can have, and opens the run's stop port."""

import contextlib
import socket

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.network.endpoint import DEFAULT_PORT, require_loopback_up
from snakesim_hal.network.free_ports import LOOPBACK, find_free_port, is_tcp_port_free
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.stop_port import find_stop_address, open_stop_port
from snakesim_hal.wire import keys
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, find_namespaces

MAX_ATTEMPTS = 10  # with ports that were free a moment ago


def reserve_endpoint(
    endpoint: str | None, router_link: ConnectionSettings | None, namespace: str
) -> tuple[ConnectionSettings, socket.socket]:
    """Reserve the endpoint at which the processes of a run connect: open the stop port with the same number.

    The caller keeps the stop port bound until the run is over. So two runs that start at the same moment cannot get the
    same endpoint: a port has one holder.

    Args:
        endpoint: Endpoint on the loopback interface; None for the default port, or another one if that is in use.
        router_link: Link to the router of a lab to connect to instead; None if the run does not join a lab.
        namespace: Namespace of the robot.

    Returns:
        The link to the endpoint, and the open socket of the stop port.

    Raises:
        NotConnectedError: No port is free.
        RefusedError: The loopback interface is down.
    """
    if router_link is not None:
        host, port = find_stop_address(router_link.endpoint, listens=False)
        return router_link, open_stop_port(host, port)
    require_loopback_up(endpoint or f"tcp/{LOOPBACK}:{DEFAULT_PORT}")
    if endpoint is not None:
        host, port = find_stop_address(endpoint, listens=True)
        return ConnectionSettings(endpoint, namespace), open_stop_port(host, port)
    for attempt in range(1 + MAX_ATTEMPTS):
        port = DEFAULT_PORT if attempt == 0 else find_free_port()
        try:
            stop_port = open_stop_port(LOOPBACK, port)
        except NotConnectedError:
            continue
        if is_tcp_port_free(port):
            return ConnectionSettings(f"tcp/{LOOPBACK}:{port}", namespace), stop_port
        stop_port.close()
    raise NotConnectedError("no free port on the loopback interface", code="network/port-in-use")


def check_no_other_robot(endpoint: str | None, router_link: ConnectionSettings | None) -> None:
    """Check that no other robot has the name or the endpoint of the run that starts.

    Args:
        endpoint: Endpoint on the loopback interface that the user gave; None for any.
        router_link: Link to the router of a lab to connect to; None if the run does not join a lab.

    Raises:
        RefusedError: Another robot has that name or endpoint.
        NotConnectedError: The router of the lab cannot be reached.
    """
    if router_link is not None:
        with open_session(router_link, CONNECT_TIMEOUT_S) as session:
            if session.list_tokens(keys.alive_key("hal")) or session.list_tokens(keys.HOST_ALL):
                raise RefusedError(
                    f"{router_link.namespace} is on {router_link.endpoint} already; end that run first, or "
                    "give this one another --namespace",
                    code="robot/already-running",
                )
    elif endpoint is not None:
        with (
            contextlib.suppress(NotConnectedError),
            open_session(ConnectionSettings(endpoint), CONNECT_TIMEOUT_S) as session,
        ):
            others = ", ".join(find_namespaces(session)) or "another host"
            raise RefusedError(
                f"{others} is on {endpoint} already; end that run first, choose another --endpoint, or join it by "
                f"--router {endpoint} with another --namespace",
                code="robot/already-running",
            )
