"""Reads the network options of a command. It does not import the network: an emergency stop reads these first."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.local_registry import LocalRobot, local_robots
from snakesim_hal.programs.arguments import check_network, read_session_option

if TYPE_CHECKING:
    from snakesim_hal.network.session import Link
    from snakesim_hal.network.session_file import SessionFile


@dataclass(frozen=True)
class RobotSelection:
    """The robots that a command addresses: those on the named endpoint, else all that run on this computer."""

    endpoint: str | None = None  # None: every network of a robot on this computer, and the default endpoint
    namespace: str | None = None  # None: every robot there
    session: "SessionFile | None" = None  # how to connect to `endpoint`, which is its first one then

    def local(self) -> list[LocalRobot]:
        """Return the addressed robots that run on this computer."""
        return [
            robot
            for robot in local_robots()
            if self.endpoint in (None, robot.endpoint) and self.namespace in (None, robot.namespace)
        ]

    def endpoints(self) -> list[str]:
        """Return the endpoints of all networks to search."""
        return [link.endpoint for link in self.networks()]

    def networks(self) -> "list[Link]":
        """Return every network to search, for the addressed namespace."""
        from snakesim_hal.network.session import Link

        if self.endpoint is not None:
            return [Link(self.endpoint, self.namespace, session=self.session)]
        links = {robot.endpoint: _link_to(robot, self.namespace) for robot in self.local()}
        if DEFAULT_ENDPOINT not in links:
            links[DEFAULT_ENDPOINT] = Link(namespace=self.namespace)
        return list(links.values())


def select_robots(arguments: argparse.Namespace) -> RobotSelection:
    """Return the robots that the arguments of `add_network` address. Raises ConfigError."""
    check_network(arguments)
    session = read_session_option(arguments, or_environment=True)
    if session is not None:
        return RobotSelection(session.endpoints[0], session.namespace_for(arguments.namespace), session)
    return RobotSelection(arguments.router or arguments.endpoint, arguments.namespace)


def _link_to(robot: LocalRobot, namespace: str | None) -> "Link":
    """Return how to reach a robot on this computer: by its session file, if this user may read that."""
    from snakesim_hal.network.session import Link
    from snakesim_hal.network.session_file import read_session

    if robot.session:
        try:
            return Link.from_session_file(read_session(Path(robot.session)), namespace)
        except ConfigError:
            pass
    return Link(robot.endpoint, namespace)
