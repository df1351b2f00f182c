"""Channels that Foxglove and Rerun show as they are, made of the newest messages a few times a second.

They are beside the raw ones, in Foxglove's protobuf schemas: `foxglove/tf` (a chain: each link in the frame of the
one behind it), `foxglove/joints`, `foxglove/reference`, `foxglove/pose`, `foxglove/scene/...` (body, obstacles, map,
forces, path), `foxglove/log`, `foxglove/depth/<name>` and `foxglove/colour/<name>`; `foxglove/state` is JSON.
"""

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

from snakesim_hal.errors import SnakesimError
from snakesim_hal.model.scenario import RunConfig, capsules_at_start
from snakesim_hal.model.scene import place
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import (
    ColourImage,
    Configuration,
    DepthImage,
    Description,
    JointState,
    Pose,
    Trajectory,
    World,
    WorldContact,
)
from snakesim_operator.recording import shapes
from snakesim_operator.recording.body_frames import BodyFrames
from snakesim_operator.recording.state_messages import State, StateMessages

MOVING_NS = 100_000_000  # 10 Hz: viewers interpolate transforms
IMAGES_NS = 200_000_000  # 5 Hz: all images are in the raw channels
TOPICS = "foxglove/"
SILENCE_NS = 5_000_000_000  # older messages are not shown as if they were current
STILL_NS = 1_000_000_000  # what seldom changes, so that it is there wherever one begins to look


class PoseAndContacts(msgspec.Struct, frozen=True):
    """What is shown of a world model at every turn: not its obstacles, which may be many."""

    base_position_w: tuple[float, float, float]
    base_orientation_wxyz: tuple[float, float, float, float]
    contacts: list[WorldContact]


_decoders: dict[type[Any], Any] = {
    message: msgspec.msgpack.Decoder(message)
    for message in (
        JointState,
        Pose,
        PoseAndContacts,
        World,
        Trajectory,
        DepthImage,
        ColourImage,
        Description,
        Configuration,
    )
}

Kind = type[Protobuf] | type[State]
ALWAYS: dict[str, Kind] = {  # topics but for those of images, of which a robot may have none
    TOPICS + name: kind
    for name, kind in {
        "tf": FrameTransforms,
        "joints": JointStates,
        "reference": JointStates,
        "state": State,
        "log": Log,
        "pose": PoseInFrame,
        **{f"scene/{part}": SceneUpdate for part in ("body", "obstacles", "map", "forces", "path")},
    }.items()
}
_KEPT = (keys.JOINTS, keys.POSE, keys.WORLD, keys.TRAJECTORY, keys.STATUS, keys.CONTROL_STATE)


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
    if issubclass(kind, State):
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
    """Keeps the newest payload of each key, and makes messages of them when the clock says that they are due."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[bytes, int]] = {}  # payload and its robot time in ns
        self._due_ns: dict[str, int] = {}
        self._robot: Description | None = None
        self._frames: BodyFrames | None = None
        self._state_messages = StateMessages()
        self._truth = shapes.obstacles([], "obstacles", shapes.TRUTH, 0)

    def take(self, key: str, payload: bytes, time_ns: int) -> list[FoxgloveMessage]:
        """What is due with this message. One that cannot be decoded makes nothing."""
        if key in _KEPT:
            self._newest[key] = payload, time_ns
            return []
        if key == keys.CLOCK:
            return self._at_clock(time_ns) if self._is_due("moving", time_ns, MOVING_NS) else []
        if key.startswith(("sensor/depth/", "sensor/colour/")):
            return list(self._image(key, payload, time_ns)) if self._is_due(key, time_ns, IMAGES_NS) else []
        if key in (keys.DESCRIPTION, keys.CONFIG):
            self._meet(key, payload)
        return []

    def _meet(self, key: str, payload: bytes) -> None:
        with suppress(SnakesimError, *UNDECODABLE):
            if key == keys.DESCRIPTION:
                robot: Description = _decoders[Description].decode(payload)
                if len(robot.links) == len(robot.joints) + 1:
                    self._robot, self._frames = robot, BodyFrames(robot)
            else:
                config = msgspec.json.decode(_decoders[Configuration].decode(payload).content, type=RunConfig)
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
        made = [_protobuf("joints", frames.joint_states(joints, time_ns))]
        base = self._base(seen, time_ns)
        made.append(_protobuf("tf", frames.transforms(joints.angle_rad, base, time_ns)))
        if base is not None:
            made.append(_protobuf("pose", _pose(*base, time_ns)))
        if seen is not None:
            made.append(_scene("forces", [shapes.forces(seen.contacts, time_ns)]))
        return [*made, *self._state(frames, time_ns), *self._still(robot, time_ns)]

    def _state(self, frames: BodyFrames, time_ns: int) -> Iterator[FoxgloveMessage]:
        status, control = (self._fresh(key, time_ns) for key in (keys.STATUS, keys.CONTROL_STATE))
        state, logged, wanted_rad = self._state_messages.of(status, control, time_ns)
        yield FoxgloveMessage(f"{TOPICS}state", State, msgspec.json.encode(state))
        yield from (_protobuf("log", one) for one in logged)
        if len(wanted_rad) == frames.joints:
            yield _protobuf("reference", frames.reference(wanted_rad, time_ns))

    def _still(self, robot: Description, time_ns: int) -> Iterator[FoxgloveMessage]:
        if self._is_due("body", time_ns, STILL_NS):
            yield _scene("body", shapes.body(robot, time_ns))
            self._truth.timestamp.CopyFrom(shapes.stamp(time_ns))
            yield _scene("obstacles", [self._truth])
        if keys.WORLD in self._newest and self._is_due(keys.WORLD, time_ns, STILL_NS):
            world: World | None = self._read(keys.WORLD, World, time_ns)
            if world is not None:
                yield _scene("map", [shapes.obstacles(world.obstacles, "map", shapes.MAP, time_ns)])
        if keys.TRAJECTORY in self._newest and self._is_due(keys.TRAJECTORY, time_ns, STILL_NS):
            trajectory: Trajectory | None = self._read(keys.TRAJECTORY, Trajectory, time_ns)
            if trajectory is not None:
                yield _scene("path", [shapes.path(trajectory.path_w, time_ns)])

    def _base(self, seen: PoseAndContacts | None, time_ns: int) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Position and orientation of link 0: as measured, else as guidance believes."""
        pose: Pose | None = self._read(keys.POSE, Pose, time_ns)
        if pose is not None:
            return pose.position_w, pose.orientation_wxyz
        return None if seen is None else (seen.base_position_w, seen.base_orientation_wxyz)

    def _image(self, key: str, payload: bytes, time_ns: int) -> Iterator[FoxgloveMessage]:
        robot = self._robot
        image: Any = _decoded(DepthImage if key.startswith("sensor/depth/") else ColourImage, payload)
        if robot is None or image is None or image.link >= len(robot.links):
            return
        name = key.removeprefix("sensor/")
        frame_id = f"{TOPICS}{name}"
        turned = shapes.optical(image.orientation_l_wxyz)
        mount = shapes.frame(time_ns, robot.links[image.link].name, frame_id, image.position_l, turned)
        yield _protobuf("tf", FrameTransforms(transforms=[mount]))
        yield _protobuf(name, shapes.raw_image(image, frame_id, time_ns))
        yield _protobuf(f"{name}/calibration", shapes.calibration(image, frame_id, time_ns))


def _decoded(message: type[Any], payload: bytes | None) -> Any:
    with suppress(*UNDECODABLE):
        return None if payload is None else _decoders[message].decode(payload)
    return None


def _pose(position: tuple[float, ...], wxyz: tuple[float, ...], time_ns: int) -> PoseInFrame:
    made = PoseInFrame(timestamp=shapes.stamp(time_ns), frame_id=shapes.WORLD_FRAME)
    made.pose.position.x, made.pose.position.y, made.pose.position.z = position
    turn = made.pose.orientation
    turn.w, turn.x, turn.y, turn.z = wxyz
    return made


def _scene(name: str, entities: list[SceneEntity]) -> FoxgloveMessage:
    return _protobuf(f"scene/{name}", SceneUpdate(entities=entities))


def _protobuf(name: str, message: Protobuf) -> FoxgloveMessage:
    return FoxgloveMessage(TOPICS + name, type(message), message.SerializeToString())
