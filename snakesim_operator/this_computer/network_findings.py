"""Findings of `snakesim doctor` about the network: the default port, and the endpoints that a user has."""

import socket
import time
from collections.abc import Iterator
from dataclasses import replace

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.network.local_registry import local_robots
from snakesim_hal.network.session import DEFAULT_ENDPOINT, open_session
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, robots_on
from snakesim_operator.this_computer.computer import Finding


def ports() -> Iterator[Finding]:
    """The default endpoint: free, a robot's, or somebody else's."""
    host, _, port = DEFAULT_ENDPOINT.partition("/")[2].rpartition(":")
    taken: list[str] = []
    for kind, name in ((socket.SOCK_STREAM, "TCP"), (socket.SOCK_DGRAM, "UDP")):
        with socket.socket(socket.AF_INET, kind) as probe:
            if kind == socket.SOCK_STREAM:  # as Zenoh binds: an ended connection does not count
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, int(port)))
            except OSError:
                taken.append(name)
    robots = [robot for robot in local_robots() if robot.endpoint == DEFAULT_ENDPOINT]
    if robots:
        detail = f"used by {robots[0].namespace}, process {robots[0].pid}"
        yield Finding(what=f"port {port}", state="ok", detail=detail)
    elif taken:
        detail = f"{' and '.join(taken)} used by another program; runs take other ports, and tools find them here"
        yield Finding(what=f"port {port}", state="warn", detail=detail, fix=[f"ss -lntup | grep {port}"])
    else:
        yield Finding(what=f"port {port}", state="ok", detail="free")


def routers(where: RobotSelection) -> Iterator[Finding]:
    """Every endpoint that was given, or has a robot of this computer."""
    links = where.networks() if where.endpoint or local_robots() else []
    for link in links:
        began = time.monotonic()
        try:
            with open_session(replace(link, namespace=None), CONNECT_S) as session:
                took_s = time.monotonic() - began
                robots = ", ".join(robots_on(session)) or "no robot"
        except SnakesimError as error:
            fix = ["snakesim start router    # there; and is a firewall between?"]
            yield Finding(what="endpoint", state="fail", detail=f"{link.endpoint}: {error}", fix=fix)
            continue
        yield Finding(what="endpoint", state="ok", detail=f"{link.endpoint} answers in {took_s * 1e3:.0f} ms: {robots}")
