"""Reads the network options of a command. It does not import the network: an emergency stop reads these first."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.local_registry import LocalRobot, list_local_robots
from snakesim_hal.programs.arguments import check_network, read_session_option

if TYPE_CHECKING:
    from snakesim_hal.network.session import ConnectionSettings
    from snakesim_hal.network.session_file import SessionFile


@dataclass(frozen=True)
class RobotSelection:
    """The robots that a command addresses: those on an endpoint, or all that run on this computer."""

    # None for all networks of robots on this computer, and the default endpoint.
    endpoint: str | None = None
    namespace: str | None = None  # None for all robots there
    # Credentials for `endpoint`, which is the first endpoint of the session then.
    session: "SessionFile | None" = None

    def list_local_robots(self) -> list[LocalRobot]:
        """List the addressed robots that run on this computer."""
        return [
            robot
            for robot in list_local_robots()
            if self.endpoint in (None, robot.endpoint) and self.namespace in (None, robot.namespace)
        ]

    def list_endpoints(self) -> list[str]:
        """List the endpoints of all networks to search."""
        return [link.endpoint for link in self.list_networks()]

    def list_networks(self) -> "list[ConnectionSettings]":
        """List the links to all networks to search, for the addressed namespace."""
        from snakesim_hal.network.session import ConnectionSettings

        if self.endpoint is not None:
            return [ConnectionSettings(self.endpoint, self.namespace, session=self.session)]
        links = {
            robot.endpoint: _make_link(robot, self.namespace) for robot in self.list_local_robots()
        }
        if DEFAULT_ENDPOINT not in links:
            links[DEFAULT_ENDPOINT] = ConnectionSettings(namespace=self.namespace)
        return list(links.values())


def select_robots(arguments: argparse.Namespace) -> RobotSelection:
    """Read the addressed robots from the network options of a command. Raises ConfigError if they are invalid."""
    check_network(arguments)
    session = read_session_option(arguments, or_environment=True)
    if session is not None:
        return RobotSelection(
            session.endpoints[0], session.resolve_namespace(arguments.namespace), session
        )
    return RobotSelection(arguments.router or arguments.endpoint, arguments.namespace)


def _make_link(robot: LocalRobot, namespace: str | None) -> "ConnectionSettings":
    """Make the link to a robot on this computer, by its session file if this user may read that."""
    from snakesim_hal.network.session import ConnectionSettings
    from snakesim_hal.network.session_file import read_session

    if robot.session:
        try:
            return ConnectionSettings.from_session_file(
                read_session(Path(robot.session)), namespace
            )
        except ConfigError:
            pass
    return ConnectionSettings(robot.endpoint, namespace)
