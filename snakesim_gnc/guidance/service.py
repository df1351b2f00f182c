"""The guidance process: reads the sensors, and publishes `guidance/world`."""

from collections.abc import Sequence
from typing import Any, Protocol, get_args

import numpy as np

from snakesim_gnc.guidance.body_history import Base
from snakesim_gnc.guidance.core import WorldModel
from snakesim_gnc.guidance.dead_reckoned_pose import DeadReckonedPose
from snakesim_gnc.guidance.estimated_contacts import (
    ContactEstimator,
    EstimatedContacts,
    can_estimate_contacts,
    mark_estimated,
)
from snakesim_gnc.guidance.localization import PoseNoise
from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.scan import Noise, RangingSample
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.scenario import RunConfig, find_start_pose, survey_obstacles
from snakesim_hal.model.sensors import DepthCamera, DistanceSensor
from snakesim_hal.network.client import Client
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    Description,
    Imu,
    JointState,
    Message,
    Obstacle,
    Pose,
    World,
)

MIN_NOISE_M = 0.001  # of a ranging sensor; one without noise in the robot's file is not trusted without limit


class Guidance(Service):
    """Makes world models from sensor samples.

    With `map = "known"` the obstacles of the scene are known as from a survey. Otherwise guidance does not use them.
    """

    name = "guidance"

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Subscribe to the sensors of the robot."""
        self._source: _WorldSource
        if config.mission.map == "perceived":
            self._source = _PerceivedSource(client, config)
        else:
            self._source = _SurveyedSource(client, config)

    def configure(self, robot: Description) -> None:
        """Create the model for this robot."""
        self._source.configure(robot)

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Return the world model at this tick; None while it is unknown."""
        world = self._source.make_world(clock)
        if world is None:
            return None
        return [(keys.WORLD, world)]


class _WorldSource(Protocol):
    """Makes world models in one of the ways."""

    def configure(self, robot: Description) -> None:
        """Create the model for this robot."""
        ...

    def make_world(self, clock: Clock) -> World | None:
        """Return the world model at this tick, from the newest samples; None while it is unknown."""
        ...


class _SurveyedSource:
    """Uses the scene's map. Dead reckoning replaces a missing pose sensor, an estimate missing contact sensors."""

    def __init__(self, client: Client, config: RunConfig) -> None:
        sensors = config.robot.sensors
        self._client = client
        self._config = config
        self._known: Sequence[Obstacle] = survey_obstacles(config)

        # Subscriptions.
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._contacts = client.subscribe(keys.CONTACTS, Contacts) if sensors.contacts else None
        self._pose = client.subscribe(keys.POSE, Pose)
        self._imu = client.subscribe(keys.IMU, Imu) if sensors.imu else None

        # Models of the robot.
        self._model: WorldModel | None = None
        self._dead_reckoned_pose: DeadReckonedPose | None = None  # for a robot without a pose sensor
        self._estimator: ContactEstimator | None = None  # for a robot without contact sensors

    def configure(self, robot: Description) -> None:
        self._model = WorldModel(robot, self._known)
        self._dead_reckoned_pose = None
        if self._config.uses_dead_reckoning(robot):
            self._dead_reckoned_pose = DeadReckonedPose(robot, _start_pose(self._config), self._known)
            print_stderr(
                "no pose sensor: the pose is estimated by dead reckoning from the start, with joints, contacts and map"
            )
        self._estimator = None
        has_contact_sensor = any(sensor.key == keys.CONTACTS for sensor in robot.sensors)
        if not has_contact_sensor and can_estimate_contacts(robot):
            self._estimator = ContactEstimator(robot)
            print_stderr("no contact sensors: contacts are estimated from the torques of the joints")

    def make_world(self, clock: Clock) -> World | None:
        """Return the world model of surveyed obstacles, from the newest samples.

        Contacts without a sensor are estimated, and a pose without a sensor is dead-reckoned; both are marked as such.

        Args:
            clock: the current tick.

        Returns:
            The world model, or None if the joint state or the sensor's pose is missing.
        """
        read = self._client.read
        joints = read(self._joints)
        pose = None
        if self._dead_reckoned_pose is None:
            pose = read(self._pose)
            if pose is None:
                return None
        if self._model is None or joints is None:
            return None
        contacts = read(self._contacts) if self._contacts else None
        estimated_contacts = None
        if contacts is None:
            estimated_contacts = self._estimate_contacts(joints, pose)
            if estimated_contacts is not None:
                contacts = estimated_contacts.contacts
        if self._dead_reckoned_pose is not None:
            pose = self._dead_reckoned_pose.move(joints, contacts, estimated=estimated_contacts is not None)
        assert pose is not None
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
        imu = self._client.read(self._imu) if self._imu and self._dead_reckoned_pose is None else None
        return self._estimator.contacts(joints, imu, pose)


class _PerceivedSource:
    """Uses only what the sensors measure, and the pose in which the robot starts."""

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Subscribe to the sensors from which the map and the pose are estimated.

        Args:
            client: connection to the robot.
            config: configuration of the run, with the robot's sensors, their noise, and the start pose.
        """
        robot = config.robot
        pose_sensor = robot.sensors.pose
        self._client = client
        self._start = _start_pose(config)
        self._pose_noise = PoseNoise()
        if pose_sensor is not None:
            self._pose_noise = PoseNoise(pose_sensor.position_noise_m, pose_sensor.angle_noise_rad)

        # Subscriptions.
        uses_pose = config.mission.localization == "pose_sensor"
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._contacts = client.subscribe(keys.CONTACTS, Contacts) if robot.sensors.contacts else None
        self._imu = client.subscribe(keys.IMU, Imu) if robot.sensors.imu else None
        self._pose = client.subscribe(keys.POSE, Pose) if uses_pose else None
        self._ranging_feeds: list[tuple[Any, Noise]] = []  # subscription to a ranging sensor, and its noise
        for key, sensor in robot.sensors.mounted():
            message_type = keys.find_message(key)
            if (
                isinstance(sensor, DistanceSensor)
                and message_type is not None
                and message_type in get_args(RangingSample)
            ):
                self._ranging_feeds.append((client.subscribe(key, message_type), _range_noise(sensor)))

        self._model: PerceivedWorld | None = None
        self._used_ns: dict[str, int] = {}  # timestamp of the newest sample that was used, by key

    def configure(self, robot: Description) -> None:
        self._model = PerceivedWorld(robot, self._start, self._pose_noise)
        self._used_ns.clear()

    def make_world(self, clock: Clock) -> World | None:
        """Update the perceived world by the newest samples, and return the world model.

        Each sample of contacts, cameras and range finders is used once.

        Args:
            clock: the current tick.

        Returns:
            The world model, or None before the robot is described or before the first joint state.
        """
        read = self._client.read
        model = self._model
        joints = read(self._joints)
        if model is None or joints is None:
            return None
        contacts = read(self._contacts) if self._contacts else None
        imu = read(self._imu) if self._imu else None
        model.add_joints(joints, contacts, imu)
        pose = read(self._pose) if self._pose else None
        if pose is not None:
            model.add_pose(pose)
        if contacts is not None and self._is_new(keys.CONTACTS, contacts.timestamp_ns):
            model.add_contacts(contacts)
        for feed, noise in self._ranging_feeds:
            sample = read(feed)
            if sample is not None and self._is_new(feed.key, sample.timestamp_ns):
                model.add_ranging_sample(sample, noise)
        return model.make_world(clock.tick, clock.timestamp_ns)

    def _is_new(self, key: str, timestamp_ns: int) -> bool:
        """Return whether a sample was not used yet, and remember it."""
        is_new = self._used_ns.get(key) != timestamp_ns
        self._used_ns[key] = timestamp_ns
        return is_new


def _start_pose(config: RunConfig) -> Base:
    """Return the pose of the base at the start of the run."""
    start = find_start_pose(config)
    return Base(np.array([*start.position_w, start.yaw_rad]), config.robot.module.radius_m, np.eye(3))


def _range_noise(sensor: DistanceSensor) -> Noise:
    """Return the noise that the robot's file declares, or a minimum."""
    per_m2 = sensor.noise_m_per_m2 if isinstance(sensor, DepthCamera) else 0.0
    return Noise(max(sensor.noise_m, MIN_NOISE_M), per_m2)
