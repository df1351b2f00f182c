"""The navigation process: world model and intent in, `navigation/trajectory` out."""

import numpy as np

from snakesim_gnc.navigation.core import KnownPath
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import RunConfig, place_all, start_of
from snakesim_hal.model.scene import route_of
from snakesim_hal.network.client import Client
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Description, Intent, Message, World

NO_ROUTE_LENGTH_M = 100.0


class Navigation(Service):
    """Mission and intent to trajectory."""

    name = "navigation"

    def __init__(self, client: Client, config: RunConfig) -> None:
        """A scene without a route gets a straight one, from where the snake starts."""
        obstacles = [placed.obstacle for placed in place_all(config) if not placed.walkable]
        route = route_of(config.scene)
        if route is None:
            start = start_of(config)
            ahead = np.array([np.cos(start.yaw_rad), np.sin(start.yaw_rad)]) * NO_ROUTE_LENGTH_M
            route = Route(np.array([start.position_w, start.position_w + ahead]))
        self._planner = KnownPath(route, obstacles, speed_m_s=config.mission.speed_m_s)
        self._world = client.subscribe(keys.WORLD, World)
        self._intent = client.subscribe(keys.INTENT, Intent)
        self._client = client

    def meet(self, robot: Description) -> None:
        """Works for any robot; its position is unknown again."""
        self._planner.start_over()

    def outputs(self, clock: Clock) -> list[tuple[str, Message]]:
        """The trajectory at this tick. An operator's intent is used as soon as it arrives."""
        world, intent = self._client.read(self._world), self._intent.newest()
        return [(keys.TRAJECTORY, self._planner.update(clock.tick, clock.stamp_ns, world, intent))]
