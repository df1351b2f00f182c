"""The guidance process: sensors in, `guidance/world` out."""

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np

from snakesim_gnc.guidance.body_history import Base
from snakesim_gnc.guidance.core import WorldModel
from snakesim_gnc.guidance.estimated_contacts import ContactEstimator, with_estimated
from snakesim_gnc.guidance.localization import PoseNoise
from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.reckoned_pose import ReckonedPose
from snakesim_gnc.guidance.scan import Look, Noise
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.scenario import RunConfig, start_of, surveyed
from snakesim_hal.model.sensors import DepthCamera, Looking
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

MIN_NOISE_M = 0.001


class Guidance(Service):
    """Sensors to world model."""

    name = "guidance"

    def __init__(self, client: Client, config: RunConfig) -> None:
        """With `map = "known"` the scene's obstacles are known as from a survey; else they are never looked at."""
        perceived = config.mission.map == "perceived"
        self._view = _Perceived(client, config) if perceived else _Surveyed(client, config)

    def configure(self, robot: Description) -> None:
        """Create the model for this robot."""
        self._view.configure(robot)

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """The world at this tick; None while it is unknown."""
        world = self._view.world(clock)
        return None if world is None else [(keys.WORLD, world)]


class _Surveyed:
    """The map is the scene's; the pose that of the sensor, or reckoned; contacts those of the sensor, or estimated."""

    def __init__(self, client: Client, config: RunConfig) -> None:
        sensors = config.robot.sensors
        self._known: Sequence[Obstacle] = surveyed(config)
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._contacts = client.subscribe(keys.CONTACTS, Contacts) if sensors.contacts else None
        self._pose = client.subscribe(keys.POSE, Pose)
        self._imu = client.subscribe(keys.IMU, Imu) if sensors.imu else None
        self._client, self._config = client, config
        self._model: WorldModel | None = None
        self._reckoned: ReckonedPose | None = None
        self._estimator: ContactEstimator | None = None

    def configure(self, robot: Description) -> None:
        self._model = WorldModel(robot, self._known)
        reckons = self._config.dead_reckons(robot)
        self._reckoned = ReckonedPose(robot, _start(self._config), self._known) if reckons else None
        sensed = any(sensor.key == keys.CONTACTS for sensor in robot.sensors)
        self._estimator = None if sensed else ContactEstimator.of(robot)
        if self._reckoned is not None:
            print_stderr("nobody measures the pose: it is reckoned from the start, by joints, contacts and the map")
        if self._estimator is not None:
            print_stderr("no sensor tells contacts: they are estimated from the torques of the joints")

    def world(self, clock: Clock) -> World | None:
        read = self._client.read
        joints = read(self._joints)
        pose = read(self._pose) if self._reckoned is None else None
        if self._model is None or joints is None or (self._reckoned is None and pose is None):
            return None
        contacts, estimated = read(self._contacts) if self._contacts else None, None
        if contacts is None and self._estimator is not None:
            imu = read(self._imu) if self._imu and self._reckoned is None else None
            estimated = self._estimator.contacts(joints, imu, pose)
            contacts = None if estimated is None else estimated.contacts
        if self._reckoned is not None:
            pose = self._reckoned.move(joints, contacts, estimated=estimated is not None)
        assert pose is not None
        world = self._model.update(clock.tick, clock.timestamp_ns, joints, contacts, pose)
        if estimated is not None:
            world = with_estimated(world, estimated)
        return world if self._reckoned is None else self._reckoned.told_in(world)


class _Perceived:
    """Map and pose are what the sensors measure. Of the scene only the place where the snake is laid down is used."""

    def __init__(self, client: Client, config: RunConfig) -> None:
        self._start, robot = _start(config), config.robot
        sensed = robot.sensors.pose
        self._noise = PoseNoise() if sensed is None else PoseNoise(sensed.position_noise_m, sensed.angle_noise_rad)
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._contacts = client.subscribe(keys.CONTACTS, Contacts) if robot.sensors.contacts else None
        self._imu = client.subscribe(keys.IMU, Imu) if robot.sensors.imu else None
        by_pose = config.mission.localization == "pose_sensor"
        self._pose = client.subscribe(keys.POSE, Pose) if by_pose else None
        self._looks = [
            (client.subscribe(key, kind), _noise(sensor))
            for key, sensor in robot.sensors.mounted()
            if isinstance(sensor, Looking) and (kind := keys.message_at(key)) is not None and kind in get_args(Look)
        ]
        self._client = client
        self._model: PerceivedWorld | None = None
        self._taken: dict[str, int] = {}  # stamp of the newest sample used, by key

    def configure(self, robot: Description) -> None:
        self._model = PerceivedWorld(robot, self._start, self._noise)
        self._taken.clear()

    def world(self, clock: Clock) -> World | None:
        read, model = self._client.read, self._model
        joints = read(self._joints)
        if model is None or joints is None:
            return None
        contacts = read(self._contacts) if self._contacts else None
        model.take_joints(joints, contacts, read(self._imu) if self._imu else None)
        pose = None if self._pose is None else read(self._pose)
        if pose is not None:
            model.take_pose(pose)
        if contacts is not None and self._is_new(keys.CONTACTS, contacts.timestamp_ns):
            model.take_contacts(contacts)
        for feed, noise in self._looks:
            look: Any = read(feed)
            if look is not None and self._is_new(feed.key, look.timestamp_ns):
                model.take_look(look, noise)
        return model.world(clock.tick, clock.timestamp_ns)

    def _is_new(self, key: str, timestamp_ns: int) -> bool:
        new = self._taken.get(key) != timestamp_ns
        self._taken[key] = timestamp_ns
        return new


def _start(config: RunConfig) -> Base:
    """Where the robot is laid down."""
    start = start_of(config)
    return Base(np.array([*start.position_w, start.yaw_rad]), config.robot.module.radius_m, np.eye(3))


def _noise(sensor: Looking) -> Noise:
    """As the robot's file has it. One without noise is not trusted without end."""
    per_m2 = sensor.noise_m_per_m2 if isinstance(sensor, DepthCamera) else 0.0
    return Noise(max(sensor.noise_m, MIN_NOISE_M), per_m2)
