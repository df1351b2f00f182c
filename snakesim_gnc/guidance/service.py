"""The guidance process: reads the sensors, and publishes `guidance/world`."""

from collections.abc import Sequence
from typing import Any, Protocol, get_args

import numpy as np

from snakesim_gnc.guidance.body_history import BasePose
from snakesim_gnc.guidance.core import SurveyedWorld
from snakesim_gnc.guidance.dead_reckoned_pose import DeadReckonedPose
from snakesim_gnc.guidance.estimated_contacts import (
    ContactEstimator,
    EstimatedContacts,
    can_estimate_contacts,
    mark_estimated,
)
from snakesim_gnc.guidance.localization import PoseNoise
from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.scan import RangeNoise, RangingSample
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.scenario import RunConfig, compute_start_pose, get_noisy_obstacle_map
from snakesim_hal.model.sensors import DepthCamera, DistanceSensor
from snakesim_hal.network.client import HostClient
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    Imu,
    JointState,
    KnownObstacle,
    Message,
    Pose,
    RobotDescription,
    WorldModel,
)

# Of a ranging sensor; one without noise in the robot's file is not trusted without limit.
MIN_RANGE_NOISE_M = 0.001


class GuidanceService(Service):
    """Makes world models from sensor samples.

    With `map = "known"` the obstacles of the scene are known as from a survey. Otherwise guidance does not use them.
    """

    name = "guidance"

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Subscribe to the sensors of the robot."""
        self._source: _WorldSource
        if config.mission.map == "perceived":
            self._source = _PerceivedSource(client, config)
        else:
            self._source = _SurveyedSource(client, config)

    def configure(self, robot: RobotDescription) -> None:
        """Create the model for this robot."""
        self._source.configure(robot)

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Return the world model at this tick; None while it is unknown."""
        world = self._source.make_world(clock)
        if world is None:
            return None
        return [(keys.WORLD, world)]


class _WorldSource(Protocol):
    """Makes world models, either from a surveyed map or from the sensors alone."""

    def configure(self, robot: RobotDescription) -> None:
        """Create the model for this robot."""
        ...

    def make_world(self, clock: Clock) -> WorldModel | None:
        """Return the world model at this tick, from the newest samples; None while it is unknown."""
        ...


class _SurveyedSource:
    """Uses the scene's map. Dead reckoning replaces a missing pose sensor, an estimate missing contact sensors."""

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Subscribe to the sensors, and read the surveyed obstacles of the scene.

        Args:
            client: Connection to the robot.
            config: Configuration of the run, with the scene and the robot's sensors.
        """
        sensors = config.robot.sensors
        self._client = client
        self._config = config
        self._surveyed_obstacles: Sequence[KnownObstacle] = get_noisy_obstacle_map(config)

        # Subscriptions.
        self._joint_feed = client.subscribe(keys.JOINTS, JointState)
        self._contact_feed = client.subscribe(keys.CONTACTS, Contacts) if sensors.contacts else None
        self._pose_feed = client.subscribe(keys.POSE, Pose)
        self._imu_feed = client.subscribe(keys.IMU, Imu) if sensors.imu else None

        # Models of the robot.
        self._model: SurveyedWorld | None = None
        # For a robot without a pose sensor.
        self._dead_reckoned_pose: DeadReckonedPose | None = None
        self._estimator: ContactEstimator | None = None  # for a robot without contact sensors

    def configure(self, robot: RobotDescription) -> None:
        self._model = SurveyedWorld(robot, self._surveyed_obstacles)
        self._dead_reckoned_pose = None
        if self._config.uses_dead_reckoning(robot):
            self._dead_reckoned_pose = DeadReckonedPose(
                robot, _make_start_pose(self._config), self._surveyed_obstacles
            )
            print_stderr(
                "no pose sensor: the pose is estimated by dead reckoning from the start, with joints, contacts and map"
            )
        self._estimator = None
        has_contact_sensor = any(sensor.key == keys.CONTACTS for sensor in robot.sensors)
        if not has_contact_sensor and can_estimate_contacts(robot):
            self._estimator = ContactEstimator(robot)
            print_stderr(
                "no contact sensors: contacts are estimated from the torques of the joints"
            )

    def make_world(self, clock: Clock) -> WorldModel | None:
        """Return the world model of surveyed obstacles, from the newest samples.

        Without a contact sensor contacts are estimated, and without a pose sensor the pose is dead-reckoned. The world
        model contains where they come from.

        Args:
            clock: The current tick.

        Returns:
            The world model, or None if the joint state or the sample of the pose sensor is missing.
        """
        read = self._client.read
        joints = read(self._joint_feed)
        pose = None
        if self._dead_reckoned_pose is None:
            pose = read(self._pose_feed)
            if pose is None:
                return None
        if self._model is None or joints is None:
            return None
        contacts = read(self._contact_feed) if self._contact_feed else None
        estimated_contacts = None
        if contacts is None:
            estimated_contacts = self._estimate_contacts(joints, pose)
            if estimated_contacts is not None:
                contacts = estimated_contacts.contacts
        if self._dead_reckoned_pose is not None:
            pose = self._dead_reckoned_pose.update(
                joints, contacts, are_contacts_estimated=estimated_contacts is not None
            )
        assert pose is not None  # either measured or dead-reckoned
        world = self._model.update(clock.tick, clock.timestamp_ns, joints, contacts, pose)
        if estimated_contacts is not None:
            world = mark_estimated(world, estimated_contacts)
        if self._dead_reckoned_pose is not None:
            world = self._dead_reckoned_pose.mark_dead_reckoned(world)
        return world

    def _estimate_contacts(self, joints: JointState, pose: Pose | None) -> EstimatedContacts | None:
        if self._estimator is None:
            return None
        # With dead reckoning no IMU is used at all, see `dead_reckoned_pose`.
        imu = (
            self._client.read(self._imu_feed)
            if self._imu_feed and self._dead_reckoned_pose is None
            else None
        )
        return self._estimator.estimate_contacts(joints, imu, pose)


class _PerceivedSource:
    """Uses only what the sensors measure, and the pose in which the robot starts."""

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Subscribe to the sensors from which the map and the pose are estimated.

        Args:
            client: Connection to the robot.
            config: Configuration of the run, with the robot's sensors, their noise, and the start pose.
        """
        robot = config.robot
        pose_sensor = robot.sensors.pose
        self._client = client
        self._start = _make_start_pose(config)
        self._pose_noise = PoseNoise()
        if pose_sensor is not None:
            self._pose_noise = PoseNoise(pose_sensor.position_noise_m, pose_sensor.angle_noise_rad)

        # Subscriptions.
        uses_pose = config.mission.localization == "pose_sensor"
        self._joint_feed = client.subscribe(keys.JOINTS, JointState)
        self._contact_feed = (
            client.subscribe(keys.CONTACTS, Contacts) if robot.sensors.contacts else None
        )
        self._imu_feed = client.subscribe(keys.IMU, Imu) if robot.sensors.imu else None
        self._pose_feed = client.subscribe(keys.POSE, Pose) if uses_pose else None
        # Subscription to a ranging sensor, and its noise.
        self._ranging_feeds: list[tuple[Any, RangeNoise]] = []
        for key, sensor in robot.sensors.iterate_mounted():
            message_type = keys.find_message(key)
            if (
                isinstance(sensor, DistanceSensor)
                and message_type is not None
                and message_type in get_args(RangingSample)
            ):
                self._ranging_feeds.append(
                    (client.subscribe(key, message_type), _make_range_noise(sensor))
                )

        self._model: PerceivedWorld | None = None
        # Timestamp of the newest sample that was used, by key.
        self._last_used_ns_by_key: dict[str, int] = {}

    def configure(self, robot: RobotDescription) -> None:
        self._model = PerceivedWorld(robot, self._start, self._pose_noise)
        self._last_used_ns_by_key.clear()

    def make_world(self, clock: Clock) -> WorldModel | None:
        """Update the perceived world by the newest samples, and return the world model.

        Each sample of contacts, cameras and range finders is used once.

        Args:
            clock: The current tick.

        Returns:
            The world model, or None before the robot is described or before the first joint state.
        """
        read = self._client.read
        model = self._model
        joints = read(self._joint_feed)
        if model is None or joints is None:
            return None
        contacts = read(self._contact_feed) if self._contact_feed else None
        imu = read(self._imu_feed) if self._imu_feed else None
        model.add_joints(joints, contacts, imu)
        pose = read(self._pose_feed) if self._pose_feed else None
        if pose is not None:
            model.add_pose(pose)
        if contacts is not None and self._mark_as_used_if_new(keys.CONTACTS, contacts.timestamp_ns):
            model.add_contacts(contacts)
        for feed, noise in self._ranging_feeds:
            sample = read(feed)
            if sample is not None and self._mark_as_used_if_new(feed.key, sample.timestamp_ns):
                model.add_ranging_sample(sample, noise)
        return model.make_world(clock.tick, clock.timestamp_ns)

    def _mark_as_used_if_new(self, key: str, timestamp_ns: int) -> bool:
        """Return whether a sample is new since the last call for its key, and store its timestamp as used."""
        is_new = self._last_used_ns_by_key.get(key) != timestamp_ns
        self._last_used_ns_by_key[key] = timestamp_ns
        return is_new


def _make_start_pose(config: RunConfig) -> BasePose:
    """Return the pose of the base at the start of the run."""
    start = compute_start_pose(config)
    return BasePose(
        np.array([*start.position_w, start.yaw_rad]), config.robot.module.radius_m, np.eye(3)
    )


def _make_range_noise(sensor: DistanceSensor) -> RangeNoise:
    """Return the noise that the robot's file declares for a ranging sensor, but at least MIN_RANGE_NOISE_M."""
    per_m2 = sensor.noise_m_per_m2 if isinstance(sensor, DepthCamera) else 0.0
    return RangeNoise(max(sensor.noise_m, MIN_RANGE_NOISE_M), per_m2)
