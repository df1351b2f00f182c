"""The navigation process: world model and intent in, `navigation/trajectory` out."""

from collections import deque

import numpy as np

from snakesim_gnc.control.body_on_path import chain_nodes, heading_of
from snakesim_gnc.navigation.beam import Search
from snakesim_gnc.navigation.clutter import ClutterPlanner
from snakesim_gnc.navigation.core import KnownPath
from snakesim_hal.model.route import Route, yaw_segments_m
from snakesim_hal.model.scenario import RunConfig, place_all, start_of
from snakesim_hal.model.scene import route_of
from snakesim_hal.network.client import Client
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Description, Intent, JointState, Message, Trajectory, World

NO_ROUTE_LENGTH_M = 100.0


class Navigation(Service):
    """Mission and intent to trajectory."""

    name = "navigation"

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Without a goal it follows the scene's route, or a straight line from where the snake starts."""
        self._config = config
        self._known = [placed.obstacle for placed in place_all(config) if not placed.walkable]
        self._world = client.subscribe(keys.WORLD, World)
        self._intent = client.subscribe(keys.INTENT, Intent)
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._client = client
        self._planner: KnownPath | Freely = self._along_route()

    def _along_route(self) -> KnownPath:
        config = self._config
        route = route_of(config.scene)
        if route is None:
            start = start_of(config)
            ahead = np.array([np.cos(start.yaw_rad), np.sin(start.yaw_rad)]) * NO_ROUTE_LENGTH_M
            route = Route(np.array([start.position_w, start.position_w + ahead]))
        return KnownPath(route, self._known, speed_m_s=config.mission.speed_m_s)

    def meet(self, robot: Description) -> None:
        """Works for any robot; its position is unknown again."""
        if self._config.mission.goal is None:
            self._planner.start_over()
        else:
            self._planner = Freely(self._config, robot, self._known)

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """The trajectory at this tick. An operator's intent is used as soon as it arrives."""
        world, intent = self._client.read(self._world), self._intent.newest()
        if isinstance(self._planner, KnownPath):
            return [(keys.TRAJECTORY, self._planner.update(clock.tick, clock.stamp_ns, world, intent))]
        told = self._planner.update(clock, world, self._client.read(self._joints), intent)
        return None if told is None else [(keys.TRAJECTORY, told)]


class Freely:
    """The planner through clutter, and the body's curve for it: pose and joint angles of one instant."""

    def __init__(self, config: RunConfig, robot: Description, known: list) -> None:
        axes = [joint.axis for joint in robot.joints]
        self._bends = [i for i, axis in enumerate(axes) if axis == "yaw"]
        self._segments_m = yaw_segments_m(axes, [link.length_m for link in robot.links])
        self._recent: deque[JointState] = deque(maxlen=128)
        goal = config.mission.goal
        assert goal is not None
        search = Search(
            body_length_m=sum(self._segments_m),
            radius_m=max(link.radius_m for link in robot.links),
            segment_m=max(self._segments_m),
        )
        self._core = ClutterPlanner(
            goal,
            known if config.mission.map == "known" else None,
            speed_m_s=config.mission.speed_m_s,
            search=search,
        )

    def start_over(self) -> None:
        """Another start."""
        self._core.start_over()

    def update(
        self, clock: Clock, world: World | None, joints: JointState | None, intent: Intent | None
    ) -> Trajectory | None:
        """The trajectory at this tick."""
        nodes = None
        if joints is not None and (not self._recent or joints.stamp_ns > self._recent[-1].stamp_ns):
            self._recent.append(joints)
        if world is not None and self._recent:
            pose_ns = world.stamp_ns if world.pose_stamp_ns is None else world.pose_stamp_ns
            held = min(self._recent, key=lambda j: abs(j.stamp_ns - pose_ns))
            bending = [held.angle_rad[i] for i in self._bends]
            heading = heading_of(world.base_orientation_wxyz)
            nodes = chain_nodes(world.base_position_w[:2], heading, bending, self._segments_m).T
        return self._core.update(clock.tick, clock.stamp_ns, world, nodes, intent)
