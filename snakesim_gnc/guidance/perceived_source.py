"""Makes world models of what the sensors alone measure."""

from typing import Any, get_args

from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.pose.localization import PoseNoise
from snakesim_gnc.guidance.ranging.scan import RangeNoise, RangingSample
from snakesim_gnc.guidance.world_source import WorldSource, make_start_pose
from snakesim_hal.model.robot_file.sensors import DepthCamera, DistanceSensor
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import HostClient
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    Imu,
    JointState,
    Pose,
    RobotDescription,
    WorldModel,
)

# Of a ranging sensor; one without noise in the robot's file is not trusted without limit.
MIN_RANGE_NOISE_M = 0.001


class PerceivedSource(WorldSource):
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
        self._start = make_start_pose(config)
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
        """Create the model for this robot."""
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


def _make_range_noise(sensor: DistanceSensor) -> RangeNoise:
    """Return the noise that the robot's file declares for a ranging sensor, but at least MIN_RANGE_NOISE_M."""
    per_m2 = sensor.noise_m_per_m2 if isinstance(sensor, DepthCamera) else 0.0
    return RangeNoise(max(sensor.noise_m, MIN_RANGE_NOISE_M), per_m2)
