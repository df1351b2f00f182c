"""The navigation process: world model and intent in, `navigation/trajectory` out."""

import msgspec
import numpy as np

from snakesim_gnc.geometry.planar_body import PlanarBody, RecentAngles, pose_instant_ns
from snakesim_gnc.navigation.beam import Search
from snakesim_gnc.navigation.clutter import ClutterPlanner
from snakesim_gnc.navigation.core import KnownPath
from snakesim_gnc.navigation.intents import Intents
from snakesim_gnc.navigation.rises import Rises
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import HeadingGoal, RunConfig, start_of, surveyed
from snakesim_hal.model.scenario import Service as Schedule
from snakesim_hal.model.scene import route_of
from snakesim_hal.network.client import Client
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Description, Intent, JointState, Message, Obstacle, Trajectory, World

NO_ROUTE_LENGTH_M = 100.0


class Navigation(Service):
    """Mission and intent to trajectory.

    Along the scene's route, or a straight line from where the snake starts. A mission with a goal, or an intent with a
    heading, is for the planner, which finds a path of its own, a little each turn: no turn waits for a plan.
    """

    name = "navigation"

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Subscribes."""
        self._config = config
        self._world = client.subscribe(keys.WORLD, World)
        self._intent = client.subscribe(keys.INTENT, Intent)
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._client = client
        self._intents = Intents(config.mission.speed_m_s)

    def configure(self, robot: Description) -> None:
        """Works for any robot; its position is unknown again."""
        config = self._config
        self._intents.start_over()
        self._body, self._recent = PlanarBody(robot), RecentAngles()
        known = surveyed(config)
        climbs = config.mission.map == "known" and any(joint.axis == "pitch" for joint in robot.joints)
        platforms = surveyed(config, walkable=True) if climbs else []
        self._rises = Rises([one for one in platforms if one.height_m <= config.mission.max_climb_m])
        self._along = _along_route(config, known) if config.mission.goal is None else None
        search = Search(
            body_length_m=self._body.length_m,
            radius_m=self._body.radius_m,
            segment_m=max(self._body.segments_m),
            peg_friction=config.mission.peg_friction,
        )
        turn = config.services.get(self.name, Schedule())
        self._planner = ClutterPlanner(
            config.mission.goal or HeadingGoal(),
            known if config.mission.map == "known" else None,
            search=search,
            turn_s=min(turn.decimation, turn.latency_ticks) / config.rate_hz,
        )

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """The trajectory at this tick. An operator's intent is used as soon as it arrives."""
        world, joints = self._client.read(self._world), self._client.read(self._joints)
        desired = self._intents.desired(self._intent.newest(), clock.timestamp_ns)
        if joints is not None:
            self._recent.add(joints.timestamp_ns, joints.angle_rad)
        if self._along is not None and desired.heading_w_rad is None:
            trajectory = self._along.update(clock.tick, world, desired)
            self._planner.follow(self._along.route, trajectory.push_points)
            return [(keys.TRAJECTORY, self._with_rises(trajectory))]
        if world is None or not self._recent:
            return None
        nodes = self._body.nodes_w(world, self._recent.nearest_to(pose_instant_ns(world)))
        trajectory = self._planner.update(clock.tick, world, nodes.T, desired)
        if not self._planner.ready and clock.clock_mode == "lockstep" and clock.arm_session == 0:
            return None  # time stands until the robot is armed, and nobody arms it before there is a path
        return [(keys.TRAJECTORY, self._with_rises(trajectory))]

    def _with_rises(self, trajectory: Trajectory) -> Trajectory:
        rises = self._rises.along(trajectory.path_id, trajectory.path_w)
        return msgspec.structs.replace(trajectory, rises=rises) if rises else trajectory


def _along_route(config: RunConfig, known: list[Obstacle]) -> KnownPath:
    route = route_of(config.scene)
    if route is None:
        start = start_of(config)
        ahead = np.array([np.cos(start.yaw_rad), np.sin(start.yaw_rad)]) * NO_ROUTE_LENGTH_M
        route = Route(np.array([start.position_w, start.position_w + ahead]))
    return KnownPath(route, known, config.mission.peg_friction)
