"""Findings of `snakesim doctor` about the network: the default port, and the endpoints that a user has."""

import socket
import time
from collections.abc import Iterator
from dataclasses import replace

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.local_registry import list_local_robots
from snakesim_hal.network.session import open_session
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, RobotSelection, find_namespaces
from snakesim_operator.this_computer.computer import ComputerFinding


def check_ports() -> Iterator[ComputerFinding]:
    """Check whether the default endpoint is free, or used by a robot or by another program."""
    host, _, port = DEFAULT_ENDPOINT.partition("/")[2].rpartition(":")
    what = f"port {port}"
    robots = [robot for robot in list_local_robots() if robot.endpoint == DEFAULT_ENDPOINT]
    used_protocols = _find_used_protocols(host, int(port))
    if robots:
        yield ComputerFinding(
            what=what, state="ok", detail=f"used by {robots[0].namespace}, process {robots[0].pid}"
        )
    elif used_protocols:
        protocols = " and ".join(used_protocols)
        detail = f"{protocols} used by another program; runs choose other ports, which the commands find here"
        yield ComputerFinding(
            what=what, state="warn", detail=detail, fix=[f"ss -lntup | grep {port}"]
        )
    else:
        yield ComputerFinding(what=what, state="ok", detail="free")


def _find_used_protocols(host: str, port: int) -> list[str]:
    """Return for which of TCP and UDP the port cannot be bound."""
    used: list[str] = []
    for kind, name in ((socket.SOCK_STREAM, "TCP"), (socket.SOCK_DGRAM, "UDP")):
        with socket.socket(socket.AF_INET, kind) as probe:
            if kind == socket.SOCK_STREAM:  # as Zenoh binds: an ended connection does not count
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                used.append(name)
    return used


def check_routers(selection: RobotSelection) -> Iterator[ComputerFinding]:
    """Check that a Zenoh router answers at every named endpoint, or that has a robot of this computer."""
    links = selection.list_networks() if selection.endpoint or list_local_robots() else []
    for link in links:
        start_s = time.monotonic()
        try:
            with open_session(replace(link, namespace=None), CONNECT_TIMEOUT_S) as session:
                duration_s = time.monotonic() - start_s
                robots = ", ".join(find_namespaces(session)) or "no robot"
        except SnakesimError as error:
            fix = ["snakesim start router    # there; and is a firewall between?"]
            detail = f"{link.endpoint}: {error}"
            yield ComputerFinding(
                what="endpoint", state="fail", detail=detail, fix=fix, code=error.code
            )
            continue
        detail = f"{link.endpoint} answers in {duration_s * 1e3:.0f} ms: {robots}"
        yield ComputerFinding(what="endpoint", state="ok", detail=detail)
