"""ROS topics of the robot's sensors: IMUs, cameras, lidars, and sensors with a custom message.

Where a sensor is mounted is known from its first sample on. Its frame is then added to the static transforms.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire import messages as m
from snakesim_hal.wire.custom_sample import find_custom_messages, find_message_type
from snakesim_operator.features.ros2 import messages as ros
from snakesim_operator.features.ros2 import robot_in_ros
from snakesim_operator.features.ros2.contact_wrenches import encode_wrenches
from snakesim_operator.features.ros2.frames import RobotFrames, make_ros_name
from snakesim_operator.features.ros2.graph import RosNode, RosPublisher, RosTopic, RosType
from snakesim_operator.features.ros2.messages import RosTransform
from snakesim_operator.features.ros2.relay import (
    ImuMeasurement,
    ImuRelay,
    NewestRelay,
    RosTime,
    TopicRelay,
)

# From ROS time in ns, frame and image to a message in CDR.
ImageEncoder = Callable[[int, str, Any], bytes]
# From ROS time in ns, frame and sample to a message in CDR.
SampleEncoder = Callable[[int, str, Any], bytes]


def _get_sensor_name(key: str) -> str:
    """Return the sensor's name, the last part of its key."""
    return key.rpartition("/")[2]


class StaticFrames:
    """Publishes the transforms that do not change, again in full whenever one of them is new."""

    def __init__(self, publisher: RosPublisher, ros_time: RosTime) -> None:
        self._publisher = publisher
        self._ros_time = ros_time
        self._fixed: list[RosTransform] = []
        self._sensors: dict[str, list[RosTransform]] = {}  # by the sensor's key

    def reset(self, frames: RobotFrames) -> None:
        """Start over with the frames of a robot whose sensors have not sent samples."""
        self._fixed = frames.fixed
        self._sensors.clear()
        self._publish_all_transforms()

    def place_sensor(self, key: str, transforms: list[RosTransform]) -> None:
        """Publish where a sensor is mounted, if that is not published."""
        if self._sensors.get(key) != transforms:
            self._sensors[key] = transforms
            self._publish_all_transforms()

    def _publish_all_transforms(self) -> None:
        transforms = list(self._fixed)
        for sensor_transforms in self._sensors.values():
            transforms += sensor_transforms
        timestamp_ns = self._ros_time.convert(self._ros_time.newest_robot_ns)
        self._publisher.publish(ros.encode_transforms(timestamp_ns, transforms))


class SensorTopics:
    """Publishes the samples of one robot's sensors."""

    def __init__(
        self,
        session: Session,
        node: RosNode,
        prefix: str,
        ros_time: RosTime,
        static_frames: StaticFrames,
    ) -> None:
        """Prepare the ROS topics of one robot's sensors; `set_robot` and `make_relays` must be called next.

        Args:
            session: Session on the robot's network.
            node: The ROS node that publishes.
            prefix: Namespace of the topics, with a slash behind it, or empty.
            ros_time: Converts robot time to ROS time.
            static_frames: Publishes where the sensors are mounted.
        """
        self._session = session
        self._node = node
        self._prefix = prefix
        self._ros_time = ros_time
        self._static_frames = static_frames
        self._imu_publishers: dict[int, RosPublisher] = {}  # by link, from the first sample on

    def set_robot(self, robot: m.RobotDescription, frames: RobotFrames) -> None:
        """Use this description and these frames from now on."""
        self._robot = robot
        self._frames = frames

    def make_relays(self, image_every_cycles: int) -> list[TopicRelay[Any]]:
        """Declare the topics of the robot's sensors, and return the relays that feed them.

        Args:
            image_every_cycles: Number of bridge cycles from one image of a camera to the next.
        """
        relays: list[TopicRelay[Any]] = []
        sensor_keys = {sensor.key for sensor in self._robot.sensors}
        if keys.CONTACTS in sensor_keys:
            relays.append(self._make_contact_relay())
        if keys.IMU in sensor_keys:
            relays.append(ImuRelay(self._session, self._forward_imus))
        for key in sorted(sensor_keys):
            name = _get_sensor_name(key)
            if key == keys.depth_key(name):
                relays.append(self._make_depth_camera_relay(key, image_every_cycles))
            elif key == keys.color_key(name):
                relays.append(self._make_color_camera_relay(key, image_every_cycles))
            elif key == keys.ranges_key(name):
                encode = robot_in_ros.encode_laser_scan
                relays.append(self._make_mounted_sensor_relay(key, "scan", ros.LASER_SCAN, encode))
        for key, custom_type in find_custom_messages(self._robot).items():
            for field in custom_type.units:
                encode_field = partial(robot_in_ros.encode_numbers, custom_type, field)
                relays.append(
                    self._make_mounted_sensor_relay(key, field, ros.FLOAT64_ARRAY, encode_field)
                )
        return relays

    def _declare_publisher(self, name: str, ros_type: RosType, **quality: Any) -> RosPublisher:
        return self._node.declare_publisher(RosTopic(f"/{self._prefix}{name}", ros_type, **quality))

    def _make_contact_relay(self) -> TopicRelay[Any]:
        """Return the relay of the contact forces, with a topic for each link."""
        names = [make_ros_name(link.name) for link in self._robot.links]
        publishers = [self._declare_publisher(f"{name}/contact", ros.WRENCH) for name in names]

        def forward(sample: m.Contacts) -> None:
            frames = [self._frames.get_link_frame(link) for link in range(len(publishers))]
            timestamp_ns = self._ros_time.convert(sample.timestamp_ns)
            for publisher, encoded in zip(
                publishers, encode_wrenches(timestamp_ns, frames, sample), strict=True
            ):
                publisher.publish(encoded)

        every_cycle = 1
        return NewestRelay(self._session, keys.CONTACTS, m.Contacts, every_cycle, forward)

    def _make_depth_camera_relay(self, key: str, every_cycles: int) -> TopicRelay[Any]:
        """Return the relay of a depth camera; its topics are named as image_transport names them."""
        topic = f"{make_ros_name(_get_sensor_name(key))}/depth/image_raw"
        raw = self._declare_image_publisher(topic, ros.IMAGE)
        compressed = self._declare_image_publisher(f"{topic}/compressedDepth", ros.COMPRESSED_IMAGE)
        outputs = (
            (raw, robot_in_ros.encode_depth_image),
            (compressed, robot_in_ros.encode_compressed_depth),
        )
        return self._make_camera_relay(key, "depth", m.DepthImage, outputs, every_cycles)

    def _make_color_camera_relay(self, key: str, every_cycles: int) -> TopicRelay[Any]:
        """Return the relay of a color camera; its topics are named as image_transport names them."""
        topic = f"{make_ros_name(_get_sensor_name(key))}/color/image_raw"
        raw = self._declare_image_publisher(topic, ros.IMAGE)
        compressed = self._declare_image_publisher(f"{topic}/compressed", ros.COMPRESSED_IMAGE)
        outputs = (
            (raw, robot_in_ros.encode_color_image),
            (compressed, robot_in_ros.encode_compressed_color),
        )
        return self._make_camera_relay(key, "color", m.ColorImage, outputs, every_cycles)

    def _declare_image_publisher(self, topic: str, ros_type: RosType) -> RosPublisher:
        return self._declare_publisher(topic, ros_type, depth=1, images=True)

    def _make_camera_relay(
        self,
        key: str,
        kind: str,
        message_type: type[Any],
        publishers_and_encoders: tuple[tuple[RosPublisher, ImageEncoder], ...],
        every_cycles: int,
    ) -> TopicRelay[Any]:
        """Make the relay of one camera, which publishes its samples as images and intrinsics.

        Images are read and encoded only while a ROS node subscribes to them.

        Args:
            key: Key of the camera.
            kind: depth or color.
            message_type: Message type of the samples.
            publishers_and_encoders: Publishers of images, each with its encoder.
            every_cycles: Number of bridge cycles from one image to the next.
        """
        name = _get_sensor_name(key)
        camera_info = self._declare_publisher(
            f"{make_ros_name(name)}/{kind}/camera_info", ros.CAMERA_INFO, depth=1
        )

        def forward(image: m.DepthImage | m.ColorImage) -> None:
            frame = self._frames.get_optical_frame(kind, name)
            timestamp_ns = self._ros_time.convert(image.timestamp_ns)
            self._static_frames.place_sensor(
                key, self._frames.make_camera_transforms(kind, name, image)
            )
            camera_info.publish(robot_in_ros.encode_camera_info(timestamp_ns, frame, image))
            for publisher, encode in publishers_and_encoders:
                if publisher.has_subscribers():
                    publisher.publish(encode(timestamp_ns, frame, image))

        def is_wanted() -> bool:
            if camera_info.has_subscribers():
                return True
            return any(publisher.has_subscribers() for publisher, _ in publishers_and_encoders)

        return NewestRelay(self._session, key, message_type, every_cycles, forward, is_wanted)

    def _make_mounted_sensor_relay(
        self, key: str, topic: str, ros_type: RosType, encode: SampleEncoder
    ) -> TopicRelay[Any]:
        """Return the relay of one topic of a sensor that is mounted on a link."""
        name = _get_sensor_name(key)
        publisher = self._declare_publisher(f"{make_ros_name(name)}/{topic}", ros_type)
        message_type: Any = find_message_type(key, self._robot)

        def forward(sample: m.MountedSample) -> None:
            self._static_frames.place_sensor(key, self._frames.make_mount_transforms(name, sample))
            timestamp_ns = self._ros_time.convert(sample.timestamp_ns)
            frame = self._frames.get_mount_frame(name)
            publisher.publish(encode(timestamp_ns, frame, sample))

        return NewestRelay(self._session, key, message_type, 1, forward, publisher.has_subscribers)

    def _forward_imus(self, measurements: dict[int, ImuMeasurement]) -> None:
        """Publish each IMU on the topic of its link.

        Which links have an IMU is known from their first samples, so topics and frames are added here. The frame of an
        IMU is published even if no ROS node subscribes to its samples, because tools such as RViz show all frames.

        Args:
            measurements: What each IMU has measured, by the index of its link.
        """
        for link_index, measurement in measurements.items():
            publisher = self._get_imu_publisher(link_index)
            self._static_frames.place_sensor(
                f"{keys.IMU}/{link_index}", [self._frames.make_imu_transform(link_index)]
            )
            # Encoding is left out for a topic that nothing reads.
            if publisher.has_subscribers():
                timestamp_ns = self._ros_time.convert(measurement.sample.timestamp_ns)
                frame = self._frames.get_imu_frame(link_index)
                publisher.publish(
                    robot_in_ros.encode_imu(
                        timestamp_ns, frame, measurement.sample, measurement.index_in_sample
                    )
                )

    def _get_imu_publisher(self, link_index: int) -> RosPublisher:
        """Return the publisher of the IMU on a link; its topic is declared at the first call."""
        publisher = self._imu_publishers.get(link_index)
        if publisher is None:
            link_name = make_ros_name(self._robot.links[link_index].name)
            publisher = self._declare_publisher(f"{link_name}/imu", ros.IMU)
            self._imu_publishers[link_index] = publisher
        return publisher
