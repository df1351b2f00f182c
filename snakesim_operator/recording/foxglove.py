"""Channels that Foxglove, PlotJuggler and Rerun show as they are, beside the raw ones, named as ROS users expect.

Numbers at the rate of the messages that they are made of: `/ROBOT/joint_states`, `/ROBOT/joint_references`,
`/ROBOT/contact_forces`, `/ROBOT/state`, and `/ROBOT/log` of its changes. What is drawn, a few times a second:
`/ROBOT/tf` (a chain: each link in the frame of the one behind it), `/ROBOT/pose`, `/ROBOT/scene/...` (body, obstacles,
map, forces, path), `/ROBOT/CAMERA/depth/image_raw` and `color`.
Forces and state are JSON with a schema, all else Foxglove's protobuf.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

import msgspec
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as Protobuf

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.model.scenario import RunConfig, capsules_at_start
from snakesim_hal.model.scene import place
from snakesim_hal.network.robot_mismatch import mismatch
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import (
    ColorImage,
    Configuration,
    Contacts,
    DepthImage,
    Description,
    JointState,
    OwnSample,
    Pose,
    Trajectory,
    World,
    WorldContact,
)
from snakesim_hal.wire.own_sample import OwnKind, own_kinds
from snakesim_operator.recording import shapes
from snakesim_operator.recording.body_frames import BodyFrames
from snakesim_operator.recording.state_messages import ContactForces, State, StateMessages

MOVING_NS = 100_000_000  # 10 Hz: viewers interpolate transforms
IMAGES_NS = 200_000_000  # 5 Hz: all images are in the raw channels
SILENCE_NS = 5_000_000_000  # older messages are not shown as if they were current
_STATE = "state"  # a name in what is due
STILL_NS = 1_000_000_000  # what seldom changes, so that it is there wherever one begins to look


class PoseAndContacts(msgspec.Struct, frozen=True):
    """What is shown of a world model at every turn: not its obstacles, which may be many."""

    base_position_w: tuple[float, float, float]
    base_orientation_wxyz: tuple[float, float, float, float]
    contacts: list[WorldContact]


_decoder: Any = cache(msgspec.msgpack.Decoder)  # of a message, by its type

Kind = type[Protobuf] | type[State] | type[ContactForces] | type[OwnSample]
ALWAYS: dict[str, Kind] = {  # topics below the robot's, but for those of images, of which a robot may have none
    "tf": FrameTransforms,
    "joint_states": JointStates,
    "joint_references": JointStates,
    "contact_forces": ContactForces,
    "state": State,
    "log": Log,
    "pose": PoseInFrame,
    **{f"scene/{part}": SceneUpdate for part in ("body", "obstacles", "map", "forces", "path")},
}
_KEPT = (keys.JOINTS, keys.POSE, keys.WORLD, keys.TRAJECTORY, keys.STATUS, keys.CONTROL_STATE)


@cache
def topic(robot: str, name: str) -> str:
    """A topic as ROS would name it. name: such as `joint_states`, below the robot's."""
    return f"/{_ros_name(robot)}/{name}"


class FoxgloveMessage(NamedTuple):
    """One message for Foxglove."""

    topic: str
    kind: Kind
    payload: bytes


class FoxgloveSchema(NamedTuple):
    """How a kind of message is encoded."""

    name: str
    message_encoding: str
    encoding: str  # of the schema
    data: bytes


@cache
def schema_of(kind: Kind) -> FoxgloveSchema:
    """As MCAP wants it: of a protobuf message its file and all that it imports."""
    if issubclass(kind, State | ContactForces | OwnSample):
        schema = msgspec.json.schema(kind)["$defs"][kind.__name__]
        return FoxgloveSchema(f"snakesim.shown.{kind.__name__}", "json", "jsonschema", msgspec.json.encode(schema))
    files: dict[str, Any] = {}

    def add(file: Any) -> None:
        for needed in file.dependencies:
            add(needed)
        files.setdefault(file.name, file)

    add(kind.DESCRIPTOR.file)
    found = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(found.file.add())
    return FoxgloveSchema(kind.DESCRIPTOR.full_name, "protobuf", "protobuf", found.SerializeToString())


class FoxgloveChannels:
    """Makes messages of numbers as they come, and of the newest payloads when the clock says that they are due."""

    def __init__(self, robot: str) -> None:
        """robot: its name in the topics."""
        self._named = robot
        self._newest: dict[str, tuple[bytes, int]] = {}  # payload and its robot time in ns
        self._due_ns: dict[str, int] = {}
        self._robot: Description | None = None
        self._frames: BodyFrames | None = None
        self._own: dict[str, OwnKind] = {}  # messages of the robot's own sensors, by key
        self._state_messages = StateMessages()
        self._truth = shapes.obstacles([], "obstacles", shapes.TRUTH, 0)

    def take(self, key: str, payload: bytes, time_ns: int) -> list[FoxgloveMessage]:
        """What is due with this message. One that cannot be decoded makes nothing."""
        if key in _KEPT:
            self._newest[key] = payload, time_ns
            if key == keys.JOINTS:
                return self._joint_states(payload, time_ns)
            return list(self._state(time_ns, key)) if key in (keys.STATUS, keys.CONTROL_STATE) else []
        if key == keys.CONTACTS:
            return self._contact_forces(payload)
        if key == keys.CLOCK:
            return self._at_clock(time_ns) if self._is_due("moving", time_ns, MOVING_NS) else []
        if key.startswith(("sensor/depth/", "sensor/color/")):
            return list(self._image(key, payload, time_ns)) if self._is_due(key, time_ns, IMAGES_NS) else []
        if key in self._own:
            return list(self._own_sample(key, payload, time_ns))
        if key in (keys.DESCRIPTION, keys.CONFIG):
            self._meet(key, payload)
        return []

    def _meet(self, key: str, payload: bytes) -> None:
        with suppress(SnakesimError, *UNDECODABLE):
            if key == keys.DESCRIPTION:
                robot: Description = _decoder(Description).decode(payload)
                if len(robot.links) == len(robot.joints) + 1:
                    self._robot, self._frames, self._own = robot, BodyFrames(robot), own_kinds(robot)
            else:
                config = msgspec.json.decode(_decoder(Configuration).decode(payload).content, type=RunConfig)
                placed = place(config.scene, capsules_at_start(config))  # checked when the run began
                self._truth = shapes.obstacles([one.obstacle for one in placed], "obstacles", shapes.TRUTH, 0)

    def _is_due(self, what: str, time_ns: int, every_ns: int) -> bool:
        due_ns = self._due_ns.get(what, 0)
        if due_ns - every_ns <= time_ns < due_ns:  # else it is late, or robot time started over
            return False
        self._due_ns[what] = time_ns + every_ns
        return True

    def _fresh(self, key: str, time_ns: int) -> bytes | None:
        """The newest payload, unless its writer has fallen silent, or robot time has started over since."""
        payload, written_ns = self._newest.get(key, (None, 0))
        return payload if 0 <= time_ns - written_ns <= SILENCE_NS else None

    def _read(self, key: str, message: type[Any], time_ns: int) -> Any:
        return _decoded(message, self._fresh(key, time_ns))

    def _at_clock(self, time_ns: int) -> list[FoxgloveMessage]:
        robot, frames = self._robot, self._frames
        joints: JointState | None = self._read(keys.JOINTS, JointState, time_ns)
        seen: PoseAndContacts | None = self._read(keys.WORLD, PoseAndContacts, time_ns)
        if robot is None or frames is None or joints is None or not joints.is_of(len(robot.joints)):
            return []
        base = self._base(seen, time_ns)
        made = [self._protobuf("tf", frames.transforms(joints.angle_rad, base, time_ns))]
        if base is not None:
            made.append(self._protobuf("pose", _pose(*base, time_ns)))
        if seen is not None:
            made.append(self._scene("forces", [shapes.forces(seen.contacts, time_ns)]))
        silent = self._state(time_ns, keys.CLOCK) if self._due_ns.get(_STATE, 0) <= time_ns else ()
        return [*made, *silent, *self._still(robot, time_ns)]

    def _joint_states(self, payload: bytes, time_ns: int) -> list[FoxgloveMessage]:
        joints: JointState | None = _decoded(JointState, payload)
        if self._frames is None or joints is None or not joints.is_of(self._frames.joints):
            return []
        made = self._frames.joint_states(joints, time_ns)
        return [FoxgloveMessage(topic(self._named, "joint_states"), JointStates, made)]

    def _contact_forces(self, payload: bytes) -> list[FoxgloveMessage]:
        felt: Contacts | None = _decoded(Contacts, payload)
        if self._robot is None or felt is None:
            return []
        return [self._json("contact_forces", ContactForces.of(felt, len(self._robot.links)))]

    def _state(self, time_ns: int, at: str) -> Iterator[FoxgloveMessage]:
        self._due_ns[_STATE] = time_ns + MOVING_NS  # then again, if host and controller have fallen silent
        status, control = (self._fresh(key, time_ns) for key in (keys.STATUS, keys.CONTROL_STATE))
        state, logged, wanted_rad = self._state_messages.of(status, control, time_ns)
        yield self._json("state", state)
        yield from (self._protobuf("log", one) for one in logged)
        if at == keys.CONTROL_STATE and self._frames is not None and len(wanted_rad) == self._frames.joints:
            made = self._frames.reference(wanted_rad, time_ns)
            yield FoxgloveMessage(topic(self._named, "joint_references"), JointStates, made)

    def _still(self, robot: Description, time_ns: int) -> Iterator[FoxgloveMessage]:
        if self._is_due("body", time_ns, STILL_NS):
            yield self._scene("body", shapes.body(robot, time_ns))
            self._truth.timestamp.CopyFrom(shapes.stamp(time_ns))
            yield self._scene("obstacles", [self._truth])
        if keys.WORLD in self._newest and self._is_due(keys.WORLD, time_ns, STILL_NS):
            world: World | None = self._read(keys.WORLD, World, time_ns)
            if world is not None:
                yield self._scene("map", [shapes.obstacles(world.obstacles, "map", shapes.MAP, time_ns)])
        if keys.TRAJECTORY in self._newest and self._is_due(keys.TRAJECTORY, time_ns, STILL_NS):
            trajectory: Trajectory | None = self._read(keys.TRAJECTORY, Trajectory, time_ns)
            if trajectory is not None:
                yield self._scene("path", [shapes.path(trajectory.path_w, time_ns)])

    def _base(self, seen: PoseAndContacts | None, time_ns: int) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Position and orientation of link 0: as measured, else as guidance believes."""
        pose: Pose | None = self._read(keys.POSE, Pose, time_ns)
        if pose is not None:
            return pose.position_w, pose.orientation_wxyz
        return None if seen is None else (seen.base_position_w, seen.base_orientation_wxyz)

    def _image(self, key: str, payload: bytes, time_ns: int) -> Iterator[FoxgloveMessage]:
        robot = self._robot
        image: Any = _decoded(DepthImage if key.startswith("sensor/depth/") else ColorImage, payload)
        if robot is None or image is None or mismatch(image, robot) is not None:
            return
        _, kind, camera = key.split("/", 2)
        kind, camera = {"color": "color"}.get(kind, kind), _ros_name(camera)
        frame_id = f"{camera}_{kind}_optical_frame"
        turned = shapes.optical(image.orientation_l_wxyz)
        mount = shapes.frame(time_ns, robot.links[image.link].name, frame_id, image.position_l, turned)
        yield self._protobuf("tf", FrameTransforms(transforms=[mount]))
        yield self._protobuf(f"{camera}/{kind}/image_raw", shapes.raw_image(image, frame_id, time_ns))
        yield self._protobuf(f"{camera}/{kind}/camera_info", shapes.calibration(image, frame_id, time_ns))

    def _scene(self, name: str, entities: list[SceneEntity]) -> FoxgloveMessage:
        return self._protobuf(f"scene/{name}", SceneUpdate(entities=entities))

    def _protobuf(self, name: str, message: Protobuf) -> FoxgloveMessage:
        return FoxgloveMessage(topic(self._named, name), type(message), message.SerializeToString())

    def _json(self, name: str, message: State | ContactForces | OwnSample) -> FoxgloveMessage:
        return FoxgloveMessage(topic(self._named, name), type(message), msgspec.json.encode(message))

    def _own_sample(self, key: str, payload: bytes, time_ns: int) -> Iterator[FoxgloveMessage]:
        """Of an own sensor, with its own schema: as JSON, which viewers plot; and its frame."""
        robot, kind = self._robot, self._own[key].message
        with suppress(*UNDECODABLE):
            sample = msgspec.msgpack.decode(payload, type=kind)
            if robot is None or sample.link >= len(robot.links):
                return
            name = _ros_name(key.rpartition("/")[2])
            if self._is_due(key, time_ns, MOVING_NS):
                place = sample.position_l, sample.orientation_l_wxyz
                mount = shapes.frame(time_ns, robot.links[sample.link].name, f"{name}_frame", *place)
                yield self._protobuf("tf", FrameTransforms(transforms=[mount]))
            yield self._json(f"own/{name}", sample)


def _decoded(message: type[Any], payload: bytes | None) -> Any:
    with suppress(*UNDECODABLE):
        return None if payload is None else _decoder(message).decode(payload)
    return None


def _pose(position: tuple[float, ...], wxyz: tuple[float, ...], time_ns: int) -> PoseInFrame:
    made = PoseInFrame(timestamp=shapes.stamp(time_ns), frame_id=shapes.WORLD_FRAME)
    made.pose.position.x, made.pose.position.y, made.pose.position.z = position
    turn = made.pose.orientation
    turn.w, turn.x, turn.y, turn.z = wxyz
    return made


def _ros_name(text: str) -> str:
    return re.sub(r"\W", "_", text, flags=re.ASCII)
