"""The network options of a command. Imports nothing of the network: an emergency stop needs them first of all."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.local_registry import LocalRobot, local_robots
from snakesim_hal.programs.arguments import check_network, session_given

if TYPE_CHECKING:
    from snakesim_hal.network.session import Link
    from snakesim_hal.network.session_file import SessionFile


@dataclass(frozen=True)
class RobotSelection:
    """Which robots a command addresses: those on the given endpoint, else all that run on this computer."""

    endpoint: str | None = None  # None: every network of a robot on this computer, and the default endpoint
    namespace: str | None = None  # None: every robot there
    session: "SessionFile | None" = None  # how to connect to `endpoint`, which is its first one then

    def local(self) -> list[LocalRobot]:
        """Addressed robots on this computer."""
        return [
            robot
            for robot in local_robots()
            if self.endpoint in (None, robot.endpoint) and self.namespace in (None, robot.namespace)
        ]

    def endpoints(self) -> list[str]:
        """Endpoints of all networks to search."""
        return [link.endpoint for link in self.networks()]

    def networks(self) -> "list[Link]":
        """Every network to search, for the addressed namespace."""
        from snakesim_hal.network.session import Link

        if self.endpoint is not None:
            return [Link(self.endpoint, self.namespace, session=self.session)]
        found = {robot.endpoint: _link_to(robot, self.namespace) for robot in self.local()}
        return list({**found, DEFAULT_ENDPOINT: found.get(DEFAULT_ENDPOINT, Link(namespace=self.namespace))}.values())


def selection_of(arguments: argparse.Namespace) -> RobotSelection:
    """What `add_network`'s arguments address. Raises ConfigError."""
    check_network(arguments)
    session = session_given(arguments, or_environment=True)
    if session is not None:
        return RobotSelection(session.endpoints[0], session.namespace_for(arguments.namespace), session)
    return RobotSelection(arguments.router or arguments.endpoint, arguments.namespace)


def _link_to(robot: LocalRobot, namespace: str | None) -> "Link":
    """How a robot on this computer has joined its network, if this user may read that file."""
    from snakesim_hal.network.session import Link
    from snakesim_hal.network.session_file import read_session

    if robot.session:
        try:
            return Link.of_file(read_session(Path(robot.session)), namespace)
        except ConfigError:
            pass
    return Link(robot.endpoint, namespace)
