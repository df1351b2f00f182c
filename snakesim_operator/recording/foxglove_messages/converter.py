"""Makes the messages for Foxglove, PlotJuggler and Rerun from the robot's messages as they arrive.

Numbers are converted at once, one message for each sample. What is drawn is made from the newest samples, a few times
a second, when it is due by the robot's clock. The topics are listed in `topics`.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import msgspec
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message as Protobuf

from snakesim_hal.base.errors import SnakesimError, WireError
from snakesim_hal.model.scenario import RunConfig, make_start_capsules
from snakesim_hal.model.scene_file.placement import place_scene_obstacles
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE, get_decoder
from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_hal.wire.messages import (
    ColorImage,
    Contacts,
    DepthImage,
    JointState,
    Pose,
    RobotDescription,
    RunConfiguration,
    Trajectory,
    WorldContact,
    WorldModel,
)
from snakesim_operator.recording.foxglove_messages import shapes
from snakesim_operator.recording.foxglove_messages.body_frames import BodyMessageEncoder
from snakesim_operator.recording.foxglove_messages.state_messages import (
    ContactForcesMessage,
    StateMessages,
)
from snakesim_operator.recording.foxglove_messages.topics import (
    FoxgloveMessage,
    JsonMessage,
    make_name_part,
    make_topic,
)

# Periods at which messages for viewers are made, in robot time.
MOTION_PERIOD_NS = 100_000_000  # 10 Hz: viewers interpolate transforms
IMAGE_PERIOD_NS = 200_000_000  # 5 Hz: all images are in the raw channels
# What seldom changes is repeated, so that it is found wherever a viewer starts.
SCENE_PERIOD_NS = 1_000_000_000
MAX_MESSAGE_AGE_NS = 5_000_000_000  # older messages are not shown as if they were current

DEPTH_PREFIX = "sensor/depth/"
COLOR_PREFIX = "sensor/color/"
_CACHED_KEYS = (
    keys.JOINTS,
    keys.POSE,
    keys.WORLD,
    keys.TRAJECTORY,
    keys.STATUS,
    keys.CONTROL_STATE,
)

# Position (3,) in m and orientation wxyz (4,) of link 0.
BasePose = tuple[Sequence[float], Sequence[float]]


class PoseAndContacts(msgspec.Struct, frozen=True):
    """The part of a world model that is shown at MOTION_PERIOD_NS: not its obstacles, which may be many."""

    base_position_w: tuple[float, float, float]
    base_orientation_wxyz: tuple[float, float, float, float]
    contacts: list[WorldContact]


_pose_and_contacts_decoder = msgspec.msgpack.Decoder(PoseAndContacts)


class FoxgloveConverter:
    """Converts one robot's messages into messages for Foxglove viewers."""

    def __init__(self, robot_name: str) -> None:
        """Start without any knowledge of the robot.

        Args:
            robot_name: Name of the robot in the viewer topics.
        """
        self._robot_name = robot_name

        # What the robot has published.
        # By key: payload, and its robot time in ns.
        self._newest_by_key: dict[str, tuple[bytes, int]] = {}
        self._robot: RobotDescription | None = None
        self._body_encoder: BodyMessageEncoder | None = None
        # Messages of the robot's custom sensors, by key.
        self._custom_message_by_key: dict[str, CustomMessage] = {}
        self._true_obstacles = shapes.draw_obstacles([], "obstacles", shapes.TRUE_OBSTACLE_COLOR, 0)

        # When messages for viewers are made next.
        # Robot time at which a drawing or an image is made next.
        self._due_ns_by_subject: dict[str, int] = {}
        self._state_due_ns = 0
        self._state_messages = StateMessages()

    def convert(self, key: str, payload: bytes, time_ns: int) -> list[FoxgloveMessage]:
        """Convert a message of the robot into messages for a Foxglove viewer.

        Drawings are made at fixed periods from the newest messages, not for each message. The clock message triggers
        the drawings that are due.

        Args:
            key: Key of the robot's message.
            payload: The encoded message, as on the network.
            time_ns: Robot time of the message.

        Returns:
            The messages for viewers; empty if nothing is due, or if the message cannot be decoded.
        """
        if key in _CACHED_KEYS:
            self._newest_by_key[key] = (payload, time_ns)
        match key:
            case keys.JOINTS:
                return self._convert_joints(payload, time_ns)
            case keys.STATUS:
                return self._make_state_messages(time_ns)
            case keys.CONTROL_STATE:
                return self._make_state_messages(time_ns, with_reference=True)
            case keys.CONTACTS:
                return self._convert_contacts(payload)
            case keys.CLOCK:
                return self._make_due_drawings(time_ns)
            case keys.DESCRIPTION:
                self._set_robot(payload)
                return []
            case keys.CONFIG:
                self._set_true_obstacles(payload)
                return []
            case _ if key.startswith((DEPTH_PREFIX, COLOR_PREFIX)):
                return self._convert_image(key, payload, time_ns)
            case _ if key in self._custom_message_by_key:
                return self._convert_custom_sample(key, payload, time_ns)
            case _:
                return []

    # --- what the robot is

    def _set_robot(self, payload: bytes) -> None:
        with suppress(SnakesimError, *UNDECODABLE):
            robot = get_decoder(RobotDescription).decode_payload(payload)
            if len(robot.links) == len(robot.joints) + 1:
                frames = BodyMessageEncoder(robot)
                custom_types = find_custom_messages(robot)
                self._robot = robot
                self._body_encoder = frames
                self._custom_message_by_key = custom_types

    def _set_true_obstacles(self, payload: bytes) -> None:
        """Compute the obstacles of the run from its configuration, placed as the simulator places them."""
        with suppress(SnakesimError, *UNDECODABLE):
            content = get_decoder(RunConfiguration).decode_payload(payload).content
            config = msgspec.json.decode(content, type=RunConfig)
            # Checked when the run began.
            placed = place_scene_obstacles(config.scene, make_start_capsules(config))
            obstacles = [body.obstacle for body in placed]
            self._true_obstacles = shapes.draw_obstacles(
                obstacles, "obstacles", shapes.TRUE_OBSTACLE_COLOR, 0
            )

    # --- when something is due

    def _check_due_and_reschedule(self, subject: str, time_ns: int, period_ns: int) -> bool:
        """Return whether a drawing is due now; if it is, schedule its next time one period later.

        Args:
            subject: What is drawn, as an identifier of the schedule.
            time_ns: Robot time now.
            period_ns: Period at which the subject is drawn.
        """
        due_ns = self._due_ns_by_subject.get(subject, 0)
        # A time more than a period before the due time means that robot time has started over.
        has_time_started_over = time_ns < due_ns - period_ns
        if time_ns < due_ns and not has_time_started_over:
            return False
        self._due_ns_by_subject[subject] = time_ns + period_ns
        return True

    def _get_recent_payload(self, key: str, time_ns: int) -> bytes | None:
        """Return the newest payload of a key; None if there is none, or if it is too old.

        A payload from the future is one from before robot time has started over, and counts as too old.
        """
        if key not in self._newest_by_key:
            return None
        payload, written_ns = self._newest_by_key[key]
        if 0 <= time_ns - written_ns <= MAX_MESSAGE_AGE_NS:
            return payload
        return None

    def _decode_recent(self, key: str, message_type: type[Any], time_ns: int) -> Any:
        """Return the newest message of a key; None if there is no recent one that can be decoded."""
        payload = self._get_recent_payload(key, time_ns)
        if payload is None:
            return None
        return _decode(message_type, payload)

    def _decode_recent_pose_and_contacts(self, time_ns: int) -> PoseAndContacts | None:
        """Return this part of the newest world model; None if there is no recent one that can be decoded."""
        payload = self._get_recent_payload(keys.WORLD, time_ns)
        if payload is None:
            return None
        with suppress(*UNDECODABLE):
            return _pose_and_contacts_decoder.decode(payload)
        return None

    # --- one message for each sample

    def _convert_joints(self, payload: bytes, time_ns: int) -> list[FoxgloveMessage]:
        joints: JointState | None = _decode(JointState, payload)
        frames = self._body_encoder
        if frames is None or joints is None or not joints.has_joint_count(frames.joint_count):
            return []
        encoded = frames.encode_joint_states(joints, time_ns)
        topic = make_topic(self._robot_name, "joint_states")
        return [FoxgloveMessage(topic, JointStates, encoded)]

    def _convert_contacts(self, payload: bytes) -> list[FoxgloveMessage]:
        contacts: Contacts | None = _decode(Contacts, payload)
        if self._robot is None or contacts is None:
            return []
        forces = ContactForcesMessage.sum_contacts(contacts, len(self._robot.links))
        return [self._encode_json("contact_forces", forces)]

    def _make_state_messages(
        self, time_ns: int, *, with_reference: bool = False
    ) -> list[FoxgloveMessage]:
        """Make the messages about the state of host and controller.

        Args:
            time_ns: Robot time now.
            with_reference: Whether to add the reference angles of the controller, if they are known.

        Returns:
            The state, a log entry for each change of it, and the reference angles if they are requested.
        """
        self._state_due_ns = time_ns + MOTION_PERIOD_NS
        status = self._get_recent_payload(keys.STATUS, time_ns)
        control = self._get_recent_payload(keys.CONTROL_STATE, time_ns)
        update = self._state_messages.update_state(status, control, time_ns)
        messages = [self._encode_json("state", update.state)]
        for log in update.new_logs:
            messages.append(self._encode_protobuf("log", log))
        frames = self._body_encoder
        if (
            with_reference
            and frames is not None
            and len(update.reference_rad) == frames.joint_count
        ):
            encoded = frames.encode_references(update.reference_rad, time_ns)
            topic = make_topic(self._robot_name, "joint_references")
            messages.append(FoxgloveMessage(topic, JointStates, encoded))
        return messages

    def _convert_custom_sample(
        self, key: str, payload: bytes, time_ns: int
    ) -> list[FoxgloveMessage]:
        """Convert a custom sensor's sample into JSON with its own schema, which viewers plot, and add its frame if due.

        Args:
            key: Key of the sample.
            payload: The encoded sample.
            time_ns: Robot time of the sample.

        Returns:
            The messages; empty if the sample cannot be decoded, or if its link is unknown.
        """
        robot = self._robot
        sample = _decode(self._custom_message_by_key[key].message, payload)
        if robot is None or sample is None or sample.link >= len(robot.links):
            return []
        name = make_name_part(key.rpartition("/")[2])
        messages: list[FoxgloveMessage] = []
        if self._check_due_and_reschedule(key, time_ns, MOTION_PERIOD_NS):
            link = robot.links[sample.link].name
            frame_id = f"{name}_frame"
            mount = shapes.make_frame_transform(
                time_ns, link, frame_id, sample.position_l, sample.orientation_l_wxyz
            )
            messages.append(self._encode_frame(mount))
        messages.append(self._encode_json(f"custom/{name}", sample))
        return messages

    # --- a few times a second

    def _convert_image(self, key: str, payload: bytes, time_ns: int) -> list[FoxgloveMessage]:
        """Convert a camera image into three messages for viewers: the camera's frame, the image, its calibration.

        Args:
            key: Key of the image, `sensor/depth/CAMERA` or `sensor/color/CAMERA`.
            payload: The encoded image.
            time_ns: Robot time of the image.

        Returns:
            The messages; empty if no image is due, if it cannot be decoded, or if it contradicts the description of
            the robot.
        """
        if not self._check_due_and_reschedule(key, time_ns, IMAGE_PERIOD_NS):
            return []
        message_type = DepthImage if key.startswith(DEPTH_PREFIX) else ColorImage
        image: Any = _decode(message_type, payload)
        robot = self._robot
        if robot is None or image is None or find_mismatch(image, robot) is not None:
            return []
        _, kind, camera = key.split("/", 2)
        camera_name = make_name_part(camera)
        topic = f"{camera_name}/{kind}"
        frame_id = f"{camera_name}_{kind}_optical_frame"
        link_name = robot.links[image.link].name
        orientation = shapes.compute_optical_orientation(image.orientation_l_wxyz)
        camera_frame = shapes.make_frame_transform(
            time_ns, link_name, frame_id, image.position_l, orientation
        )
        raw_image = shapes.make_raw_image(image, frame_id, time_ns)
        calibration = shapes.make_calibration(image, frame_id, time_ns)
        return [
            self._encode_frame(camera_frame),
            self._encode_protobuf(f"{topic}/image_raw", raw_image),
            self._encode_protobuf(f"{topic}/camera_info", calibration),
        ]

    def _make_due_drawings(self, time_ns: int) -> list[FoxgloveMessage]:
        """Make transforms, pose, contact forces and scene for viewers, from the newest messages of the robot.

        Args:
            time_ns: Robot time now.

        Returns:
            The messages; empty if no drawing is due, or if the robot or its joint angles are unknown.
        """
        if not self._check_due_and_reschedule("moving", time_ns, MOTION_PERIOD_NS):
            return []
        robot = self._robot
        frames = self._body_encoder
        joints: JointState | None = self._decode_recent(keys.JOINTS, JointState, time_ns)
        world = self._decode_recent_pose_and_contacts(time_ns)
        if robot is None or frames is None:
            return []
        if joints is None or not joints.has_joint_count(len(robot.joints)):
            return []
        base = self._find_base_pose(world, time_ns)
        transforms = frames.fill_transforms(joints.angle_rad, base, time_ns)
        messages = [self._encode_protobuf("tf", transforms)]
        if base is not None:
            messages.append(self._encode_protobuf("pose", _make_pose_in_frame(base, time_ns)))
        if world is not None:
            forces = shapes.draw_forces(world.contacts, time_ns)
            messages.append(self._encode_scene("forces", [forces]))
        # Messages of host and controller trigger the state. If both are silent, the state must show that.
        if self._state_due_ns <= time_ns:
            messages += self._make_state_messages(time_ns)
        messages += self._make_due_scene_messages(robot, time_ns)
        return messages

    def _make_due_scene_messages(
        self, robot: RobotDescription, time_ns: int
    ) -> list[FoxgloveMessage]:
        """Make the drawings that seldom change: body, obstacles, map and path, each if it is due."""
        messages: list[FoxgloveMessage] = []
        if self._check_due_and_reschedule("body", time_ns, SCENE_PERIOD_NS):
            links = shapes.draw_body(robot, time_ns)
            messages.append(self._encode_scene("body", links))
            self._true_obstacles.timestamp.CopyFrom(shapes.make_timestamp(time_ns))
            messages.append(self._encode_scene("obstacles", [self._true_obstacles]))
        world: WorldModel | None = self._decode_if_scene_due(keys.WORLD, WorldModel, time_ns)
        if world is not None:
            obstacles = shapes.draw_obstacles(world.obstacles, "map", shapes.MAP_COLOR, time_ns)
            messages.append(self._encode_scene("map", [obstacles]))
        trajectory: Trajectory | None = self._decode_if_scene_due(
            keys.TRAJECTORY, Trajectory, time_ns
        )
        if trajectory is not None:
            path = shapes.draw_path(trajectory.path_w, time_ns)
            messages.append(self._encode_scene("path", [path]))
        return messages

    def _decode_if_scene_due(self, key: str, message_type: type[Any], time_ns: int) -> Any:
        """Return the newest message of a key if its drawing in the scene is due; else None."""
        if key not in self._newest_by_key:
            return None
        if not self._check_due_and_reschedule(key, time_ns, SCENE_PERIOD_NS):
            return None
        return self._decode_recent(key, message_type, time_ns)

    def _find_base_pose(self, world: PoseAndContacts | None, time_ns: int) -> BasePose | None:
        """Return the pose of link 0: the measured one, else the one estimated by the world model, else None."""
        pose: Pose | None = self._decode_recent(keys.POSE, Pose, time_ns)
        if pose is not None:
            return pose.position_w, pose.orientation_wxyz
        if world is not None:
            return world.base_position_w, world.base_orientation_wxyz
        return None

    # --- encoding

    def _encode_scene(self, name: str, entities: list[SceneEntity]) -> FoxgloveMessage:
        return self._encode_protobuf(f"scene/{name}", SceneUpdate(entities=entities))

    def _encode_frame(self, frame: FrameTransform) -> FoxgloveMessage:
        return self._encode_protobuf("tf", FrameTransforms(transforms=[frame]))

    def _encode_protobuf(self, name: str, message: Protobuf) -> FoxgloveMessage:
        topic = make_topic(self._robot_name, name)
        return FoxgloveMessage(topic, type(message), message.SerializeToString())

    def _encode_json(self, name: str, message: JsonMessage) -> FoxgloveMessage:
        topic = make_topic(self._robot_name, name)
        return FoxgloveMessage(topic, type(message), msgspec.json.encode(message))


def _decode(message_type: type[Any], payload: bytes) -> Any:
    """Return a decoded message, or None if the payload does not fit its type."""
    with suppress(WireError):
        return get_decoder(message_type).decode_payload(payload)
    return None


def _make_pose_in_frame(base: BasePose, time_ns: int) -> PoseInFrame:
    position_w, orientation_wxyz = base
    message = PoseInFrame(timestamp=shapes.make_timestamp(time_ns), frame_id=shapes.WORLD_FRAME)
    position = message.pose.position
    position.x, position.y, position.z = position_w
    orientation = message.pose.orientation
    orientation.w, orientation.x, orientation.y, orientation.z = orientation_wxyz
    return message
