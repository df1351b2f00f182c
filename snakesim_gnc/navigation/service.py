"""The navigation process: reads the world model and intents, and publishes `navigation/trajectory`."""

from collections.abc import Sequence

import msgspec
import numpy as np

from snakesim_gnc.geometry.planar_body import JointAngleHistory, PlanarBody, get_pose_time_ns
from snakesim_gnc.navigation.clutter import ClutterPlanner
from snakesim_gnc.navigation.intents import DesiredMotion, IntentTracker
from snakesim_gnc.navigation.known_path import KnownPath
from snakesim_gnc.navigation.path_search.search_parameters import SearchParameters
from snakesim_gnc.navigation.platform_rises import PlatformRises
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.model.scenario import (
    HeadingGoal,
    RunConfig,
    ServiceSchedule,
    compute_start_pose,
    get_noisy_obstacle_map,
)
from snakesim_hal.model.scene_file.scene import make_route
from snakesim_hal.network.client import HostClient
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    JointState,
    KnownObstacle,
    LocomotionIntent,
    Message,
    RobotDescription,
    Trajectory,
    WorldModel,
)

DEFAULT_ROUTE_LENGTH_M = 100.0  # of the straight line that a scene without a route gets


class NavigationService(Service):
    """Makes trajectories from the mission and intents.

    Without a goal the robot follows the scene's route, or a straight line from its start. For a mission with a goal, or
    an intent with a heading, the clutter planner plans paths, a limited amount of work in each update.
    """

    name = "navigation"

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Subscribe to the world model, intents and joint states."""
        self._config = config
        self._client = client
        self._world_feed = client.subscribe(keys.WORLD, WorldModel)
        self._intent_feed = client.subscribe(keys.INTENT, LocomotionIntent)
        self._joint_feed = client.subscribe(keys.JOINTS, JointState)
        self._intents = IntentTracker(config.mission.speed_m_s)

    def configure(self, robot: RobotDescription) -> None:
        """Create the planners for a robot, after a start or a reconnection, when the robot's position is unknown.

        Args:
            robot: Description of the robot.
        """
        config = self._config
        mission = config.mission
        # Of the scene file, whether or not the mission knows them.
        surveyed_obstacles = get_noisy_obstacle_map(config)
        self._intents.reset()
        self._body = PlanarBody(robot)
        self._recent_angles = JointAngleHistory()
        self._rises = PlatformRises(_find_platforms(config, robot))

        # Without a goal the robot follows a known path. The clutter planner is for goals, and intents with a heading.
        self._known_path = None
        if mission.goal is None:
            self._known_path = _make_known_path(config, surveyed_obstacles)
        has_map = mission.map == "known"
        schedule = config.services.get(self.name, ServiceSchedule())
        self._planner = ClutterPlanner(
            mission.goal or HeadingGoal(),
            surveyed_obstacles if has_map else None,
            search_parameters=SearchParameters(
                body_length_m=self._body.length_m,
                radius_m=self._body.radius_m,
                segment_m=max(self._body.segments_m),
                assumed_obstacle_friction=mission.assumed_obstacle_friction,
            ),
            # Time for the work of one update: until the next one, or the latency of the service if that is less.
            update_period_s=min(schedule.decimation, schedule.latency_ticks) / config.rate_hz,
        )

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Return the trajectory that the robot shall follow from this tick on, with its platforms to climb.

        It follows the known path, unless there is a goal or an operator commands a heading: then the clutter planner
        plans it. An operator's intent is used as soon as it arrives.

        Args:
            clock: The tick and its time.

        Returns:
            The message and its key; None while there is no trajectory.
        """
        world = self._client.read(self._world_feed)
        joints = self._client.read(self._joint_feed)
        desired = self._intents.choose_motion(self._intent_feed.newest(), clock.timestamp_ns)
        if joints is not None:
            self._recent_angles.add(joints.timestamp_ns, joints.angle_rad)
        if self._known_path is not None and desired.heading_w_rad is None:
            trajectory = self._known_path.update(clock.tick, world, desired)
            self._planner.follow_route(self._known_path.route, trajectory.push_points)
        else:
            trajectory = self._plan_trajectory(clock, world, desired)
        if trajectory is None:
            return None
        return [(keys.TRAJECTORY, self._add_rises(trajectory))]

    def _plan_trajectory(
        self, clock: Clock, world: WorldModel | None, desired: DesiredMotion
    ) -> Trajectory | None:
        """Return the trajectory of the clutter planner; None without a world model or while time waits for a path."""
        if world is None or not self._recent_angles:
            return None
        angles_rad = self._recent_angles.find_nearest(get_pose_time_ns(world))
        body_points_w = self._body.compute_body_points_w(world, angles_rad)
        trajectory = self._planner.update(clock.tick, world, body_points_w.T, desired)
        is_paused = clock.clock_mode == "lockstep" and clock.arm_session == 0
        if is_paused and not self._planner.has_plan:
            # Robot time is paused until the robot is armed, and the robot is armed only when there is a path.
            return None
        return trajectory

    def _add_rises(self, trajectory: Trajectory) -> Trajectory:
        rises = self._rises.find_rises(trajectory.path_id, trajectory.path_w)
        if not rises:
            return trajectory
        return msgspec.structs.replace(trajectory, rises=rises)


def _find_platforms(config: RunConfig, robot: RobotDescription) -> Sequence[KnownObstacle]:
    """Return the surveyed platforms that the robot may climb; an empty list without pitch joints or a known map."""
    can_pitch = any(joint.axis == "pitch" for joint in robot.joints)
    if config.mission.map != "known" or not can_pitch:
        return []
    platforms = get_noisy_obstacle_map(config, walkable=True)
    return [platform for platform in platforms if platform.height_m <= config.mission.max_climb_m]


def _make_known_path(config: RunConfig, known_obstacles: Sequence[KnownObstacle]) -> KnownPath:
    """Return the path along the scene's route, or straight ahead from the start if it has none."""
    route = make_route(config.scene)
    if route is None:
        start = compute_start_pose(config)
        ahead = np.array([np.cos(start.yaw_rad), np.sin(start.yaw_rad)]) * DEFAULT_ROUTE_LENGTH_M
        route = Route(np.array([start.position_w, start.position_w + ahead]))
    return KnownPath(route, known_obstacles, config.mission.assumed_obstacle_friction)
