"""Converts a recording into a ROS 2 bag: the topics of the bridge, at the full rate of the robot's messages."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from snakesim_hal.base.errors import ConfigError, WireError
from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.model.textfiles import export_atomically
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.wire import keys
from snakesim_hal.wire import messages as m
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_operator.features.ros2 import messages as ros
from snakesim_operator.features.ros2 import robot_in_ros
from snakesim_operator.features.ros2.contact_wrenches import encode_wrenches
from snakesim_operator.features.ros2.frames import RobotFrames, make_ros_name
from snakesim_operator.features.ros2.graph import RosType
from snakesim_operator.features.ros2.urdf import make_urdf
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.missing_data import report_missing_data
from snakesim_operator.results.run_reader import find_recording_path

BAG_VERSION = 9  # of metadata.yaml, as of ROS 2 Jazzy
LATCHED_TOPICS = ("/robot_description", "/tf_static")
UNLIMITED_TIME = QosTime(0, 0)
LATCHED_QOS = Qos(  # so that a node that subscribes while the bag is played gets the newest message
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=UNLIMITED_TIME,
    lifespan=UNLIMITED_TIME,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=UNLIMITED_TIME,
    avoid_ros_namespace_conventions=False,
)
MESSAGE_TYPES: dict[str, type[Any]] = {
    keys.JOINTS: m.JointState,
    keys.POSE: m.Pose,
    keys.CONTACTS: m.Contacts,
    keys.IMU: m.Imu,
    keys.STATUS: m.RobotStatus,
    keys.CLOCK: m.Clock,
    keys.DESCRIPTION: m.RobotDescription,
}
BagMessage = tuple[str, RosType, bytes]  # topic, type and message in CDR


def convert_recording_to_rosbag(
    run: Path, output_path: Path | None, print_text: PrintLine, *, wall_time: bool
) -> int:
    """Write a recording as a ROS 2 bag with MCAP storage.

    Args:
        run: Path of a run folder, or of a recording.
        output_path: Folder of the bag to write; None for a folder next to the recording.
        print_text: Prints a line.
        wall_time: Whether times and stamps are wall-clock time instead of robot time.

    Returns:
        The exit code: 3 if the recording is incomplete, otherwise 0.

    Raises:
        ConfigError: The recording cannot be read, has no description of its robot, or the folder exists.
    """
    recording = find_recording_path(run)
    rosbag_path = output_path or recording.with_name(f"{recording.stem}-rosbag")
    if rosbag_path.exists():
        raise ConfigError(
            f"{rosbag_path}: there is such a folder already; choose another one with --out",
            code="file/already-exists",
        )
    reader = RecordingReader(recording)
    with export_atomically(rosbag_path) as temporary_folder:
        # The library names the file in the bag after this folder.
        bag_folder = temporary_folder / rosbag_path.name
        temporary_folder.mkdir()
        message_count = _write_bag(reader, bag_folder, wall_time=wall_time)
        for file in list(bag_folder.iterdir()):
            file.rename(temporary_folder / file.name)
        bag_folder.rmdir()
        if not message_count:
            raise ConfigError(
                f"{recording}: it has no hal/description, so the joints have no names; record a robot with its host",
                code="recording/missing-data",
            )
    print_text(f"{message_count} messages: {rosbag_path}")
    return report_missing_data(run, reader.missing)


def _write_bag(reader: RecordingReader, path: Path, *, wall_time: bool) -> int:
    """Convert all messages of a recording, and return the number of messages in the bag."""
    count = 0
    with Writer(path, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        bag = _BagTopics(writer)
        converter = MessageConverter(wall_time=wall_time)
        for recorded in reader.read_messages(MESSAGE_TYPES):
            time_ns = recorded.wall_time_ns if wall_time else recorded.robot_time_ns
            for output in converter.convert(recorded):
                bag.write_message(output, time_ns)
                count += 1
    return count


class _BagTopics:
    """The topics of a bag that is being written."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._connections: dict[str, Any] = {}  # by topic

    def write_message(self, output: BagMessage, time_ns: int) -> None:
        """Write one message, and open its topic when it is the first one."""
        topic, ros_type, data = output
        if topic not in self._connections:
            quality = [LATCHED_QOS] if topic in LATCHED_TOPICS else []
            self._connections[topic] = self._writer.add_connection(
                topic, ros_type.name, typestore=ros.TYPE_STORE, offered_qos_profiles=quality
            )
        self._writer.write(self._connections[topic], time_ns, data)


class MessageConverter:
    """Converts the robot's messages into those of ROS, with the topics and frames of the bridge."""

    def __init__(self, *, wall_time: bool) -> None:
        """Start without a robot. `wall_time` is whether stamps are wall-clock time instead of robot time."""
        self._wall_time = wall_time
        self._decoders = {
            key: MessageDecoder(message_type) for key, message_type in MESSAGE_TYPES.items()
        }
        self._robot: m.RobotDescription | None = None
        self._frames: RobotFrames | None = None
        self._known_imu_links: set[int] = set()  # whose frames are known

    def convert(self, recorded: RecordedMessage) -> Iterable[BagMessage]:
        """Convert a recorded message of the robot into ROS messages.

        Args:
            recorded: The message, with its key and its times.

        Returns:
            Topic, type and CDR data of each ROS message; empty if the message is invalid or does not fit the robot.
        """
        try:
            message = self._decoders[recorded.key].decode(recorded.payload, recorded.encoding)
        except WireError:
            return []
        timestamp_ns = (
            recorded.wall_time_ns
            if self._wall_time
            else getattr(message, "timestamp_ns", recorded.robot_time_ns)
        )
        if isinstance(message, m.RobotDescription):
            return self._use_robot(message, timestamp_ns)
        robot = self._robot
        frames = self._frames
        if robot is None or frames is None or find_mismatch(message, robot) is not None:
            return []
        match message:
            case m.JointState():
                return self._convert_joints(message, robot, frames, timestamp_ns)
            case m.Pose():
                transforms = [frames.make_base_transform(message)]
                return [("/tf", ros.TRANSFORMS, ros.encode_transforms(timestamp_ns, transforms))]
            case m.Contacts():
                return _convert_contacts(message, robot, frames, timestamp_ns)
            case m.Imu():
                return self._convert_imus(message, frames, timestamp_ns)
            case m.RobotStatus():
                return [
                    (
                        "/diagnostics",
                        ros.DIAGNOSTICS,
                        robot_in_ros.encode_diagnostics(timestamp_ns, message),
                    )
                ]
            case m.Clock() if not self._wall_time:
                return [("/clock", ros.CLOCK, ros.encode_clock(timestamp_ns))]
            case _:
                return []

    def _use_robot(self, robot: m.RobotDescription, timestamp_ns: int) -> list[BagMessage]:
        """Use this description from now on, and return it as URDF with the fixed frames."""
        if len(robot.links) != len(robot.joints) + 1:
            return []
        self._robot = robot
        self._frames = RobotFrames(robot)
        return [
            ("/robot_description", ros.STRING, ros.encode_string(make_urdf(robot))),
            ("/tf_static", ros.TRANSFORMS, ros.encode_transforms(timestamp_ns, self._frames.fixed)),
        ]

    def _convert_joints(
        self,
        joints: m.JointState,
        robot: m.RobotDescription,
        frames: RobotFrames,
        timestamp_ns: int,
    ) -> list[BagMessage]:
        names = [joint.name for joint in robot.joints]
        transforms = frames.make_joint_transforms(joints)
        return [
            (
                "/joint_states",
                ros.JOINT_STATE,
                robot_in_ros.encode_joint_state(timestamp_ns, names, joints),
            ),
            ("/tf", ros.TRANSFORMS, ros.encode_transforms(timestamp_ns, transforms)),
        ]

    def _convert_imus(
        self, imus: m.Imu, frames: RobotFrames, timestamp_ns: int
    ) -> list[BagMessage]:
        """Return a message for each IMU, and its frame with the first one."""
        outputs: list[BagMessage] = []
        for entry, link in enumerate(imus.link):
            if link not in self._known_imu_links:
                self._known_imu_links.add(link)
                transforms = [frames.make_imu_transform(link)]
                outputs.append(
                    ("/tf_static", ros.TRANSFORMS, ros.encode_transforms(timestamp_ns, transforms))
                )
            topic = f"/{make_ros_name(frames.get_link_frame(link))}/imu"
            data = robot_in_ros.encode_imu(timestamp_ns, frames.get_imu_frame(link), imus, entry)
            outputs.append((topic, ros.IMU, data))
        return outputs


def _convert_contacts(
    contacts: m.Contacts, robot: m.RobotDescription, frames: RobotFrames, timestamp_ns: int
) -> list[BagMessage]:
    """Return a wrench for each link."""
    link_frames = [frames.get_link_frame(link) for link in range(len(robot.links))]
    wrenches = encode_wrenches(timestamp_ns, link_frames, contacts)
    return [
        (f"/{make_ros_name(link.name)}/contact", ros.WRENCH, data)
        for link, data in zip(robot.links, wrenches, strict=True)
    ]
