"""Channels that Foxglove and Rerun show as they are, made of the newest messages a few times a second.

They are beside the raw ones, in Foxglove's protobuf schemas: `foxglove/tf`, `foxglove/joints`, `foxglove/pose`,
`foxglove/scene/...` (body, obstacles, map, forces, path), `foxglove/depth/<name>` and `foxglove/colour/<name>`.
"""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState as NamedJoint
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as Protobuf

from snakesim_hal.errors import SnakesimError
from snakesim_hal.model.kinematics import link_frames, quaternions_from_rotations, rotation_from_quaternion
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
    Obstacle,
    Pose,
    Trajectory,
    World,
    WorldContact,
)
from snakesim_operator.recording import shapes

MOVING_NS = 100_000_000  # 10 Hz: viewers interpolate transforms
IMAGES_NS = 200_000_000  # 5 Hz: all images are in the raw channels
STILL_NS = 1_000_000_000  # what seldom changes, so that it is there wherever one begins to look


class Seen(msgspec.Struct, frozen=True):
    """What is shown of a world model at every turn: not its obstacles, which may be many."""

    base_position_w: tuple[float, float, float]
    base_orientation_wxyz: tuple[float, float, float, float]
    contacts: list[WorldContact]


_decoders: dict[type[Any], Any] = {
    message: msgspec.msgpack.Decoder(message)
    for message in (JointState, Pose, Seen, World, Trajectory, DepthImage, ColourImage, Description, Configuration)
}

Made = tuple[str, Protobuf]


def descriptor_set(message: Protobuf) -> bytes:
    """A message's schema as MCAP wants it: its file and all that it imports."""
    files: dict[str, Any] = {}

    def add(file: Any) -> None:
        for needed in file.dependencies:
            add(needed)
        files.setdefault(file.name, file)

    add(message.DESCRIPTOR.file)
    found = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(found.file.add())
    return found.SerializeToString()


class FoxgloveChannels:
    """Keeps the newest payload of each key, and makes messages of them when the clock says that they are due."""

    def __init__(self) -> None:
        self._newest: dict[str, bytes] = {}
        self._due_ns: dict[str, int] = {}
        self._robot: Description | None = None
        self._truth: list[Obstacle] = []

    def take(self, key: str, payload: bytes, time_ns: int) -> list[Made]:
        """What is due with this message. One that cannot be decoded makes nothing."""
        if key == keys.CLOCK:
            return self._at_clock(time_ns) if self._is_due("moving", time_ns, MOVING_NS) else []
        with suppress(SnakesimError, *UNDECODABLE):
            if key == keys.DESCRIPTION:
                self._robot = _decoders[Description].decode(payload)
            elif key == keys.CONFIG:
                config = msgspec.json.decode(_decoders[Configuration].decode(payload).content, type=RunConfig)
                placed = place(config.scene, capsules_at_start(config))  # checked when the run began
                self._truth = [one.obstacle for one in placed]
            elif key.startswith(("sensor/depth/", "sensor/colour/")):
                return list(self._image(key, payload, time_ns)) if self._is_due(key, time_ns, IMAGES_NS) else []
            else:
                self._newest[key] = payload
        return []

    def _is_due(self, what: str, time_ns: int, every_ns: int) -> bool:
        due_ns = self._due_ns.get(what, 0)
        if due_ns - every_ns <= time_ns < due_ns:  # else it is late, or robot time began anew
            return False
        self._due_ns[what] = time_ns + every_ns
        return True

    def _read(self, key: str, message: type[Any]) -> Any:
        payload = self._newest.get(key)
        with suppress(*UNDECODABLE):
            return None if payload is None else _decoders[message].decode(payload)
        return None

    def _at_clock(self, time_ns: int) -> list[Made]:
        robot = self._robot
        joints: JointState | None = self._read(keys.JOINTS, JointState)
        seen: Seen | None = self._read(keys.WORLD, Seen)
        if robot is None or joints is None or not joints.is_of(len(robot.joints)):
            return []
        made: list[Made] = [("foxglove/joints", _joint_states(robot, joints, time_ns))]
        base = self._base(seen)
        if base is not None:
            frames = _frames(robot, joints, *base, time_ns)
            made += [("foxglove/tf", FrameTransforms(transforms=frames)), ("foxglove/pose", _pose(*base, time_ns))]
        if seen is not None:
            made.append(_scene("forces", [shapes.forces(seen.contacts, time_ns)]))
        return [*made, *self._still(robot, time_ns)]

    def _still(self, robot: Description, time_ns: int) -> Iterator[Made]:
        if self._is_due("body", time_ns, STILL_NS):
            yield _scene("body", shapes.body(robot, time_ns))
            yield _scene("obstacles", [shapes.obstacles(self._truth, "obstacles", shapes.TRUTH, time_ns)])
        if keys.WORLD in self._newest and self._is_due(keys.WORLD, time_ns, STILL_NS):
            world: World | None = self._read(keys.WORLD, World)
            if world is not None:
                yield _scene("map", [shapes.obstacles(world.obstacles, "map", shapes.MAP, time_ns)])
        if keys.TRAJECTORY in self._newest and self._is_due(keys.TRAJECTORY, time_ns, STILL_NS):
            trajectory: Trajectory | None = self._read(keys.TRAJECTORY, Trajectory)
            if trajectory is not None:
                yield _scene("path", [shapes.path(trajectory.path_w, time_ns)])

    def _base(self, seen: Seen | None) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Position and orientation of link 0: as measured, else as guidance believes."""
        pose: Pose | None = self._read(keys.POSE, Pose)
        if pose is not None:
            return pose.position_w, pose.orientation_wxyz
        return None if seen is None else (seen.base_position_w, seen.base_orientation_wxyz)

    def _image(self, key: str, payload: bytes, time_ns: int) -> Iterator[Made]:
        robot = self._robot
        image: Any = _decoders[DepthImage if key.startswith("sensor/depth/") else ColourImage].decode(payload)
        if robot is None or image.link >= len(robot.links):
            return
        topic = f"foxglove/{key.removeprefix('sensor/')}"
        turned = shapes.optical(image.orientation_l_wxyz)
        mount = shapes.frame(time_ns, robot.links[image.link].name, topic, image.position_l, turned)
        yield "foxglove/tf", FrameTransforms(transforms=[mount])
        yield topic, shapes.raw_image(image, topic, time_ns)
        yield f"{topic}/calibration", shapes.calibration(image, topic, time_ns)


def _frames(
    robot: Description, joints: JointState, position: tuple[float, ...], wxyz: tuple[float, ...], time_ns: int
) -> list[Any]:
    axes, lengths = [joint.axis for joint in robot.joints], [link.length_m for link in robot.links]
    angles = np.array(joints.angle_rad)
    origins, rotations = link_frames(np.array(position), rotation_from_quaternion(wxyz), angles, axes, lengths)
    turned = quaternions_from_rotations(np.array(rotations)).tolist()
    placed = zip(robot.links, np.array(origins).tolist(), turned, strict=True)
    return [shapes.frame(time_ns, shapes.WORLD_FRAME, link.name, at, turn) for link, at, turn in placed]


def _joint_states(robot: Description, joints: JointState, time_ns: int) -> JointStates:
    numbers = zip(robot.joints, joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, strict=True)
    named = [NamedJoint(name=one.name, position=at, velocity=speed, effort=nm) for one, at, speed, nm in numbers]
    return JointStates(timestamp=shapes.stamp(time_ns), joints=named)


def _pose(position: tuple[float, ...], wxyz: tuple[float, ...], time_ns: int) -> PoseInFrame:
    made = PoseInFrame(timestamp=shapes.stamp(time_ns), frame_id=shapes.WORLD_FRAME)
    made.pose.position.x, made.pose.position.y, made.pose.position.z = position
    turn = made.pose.orientation
    turn.w, turn.x, turn.y, turn.z = wxyz
    return made


def _scene(name: str, entities: list[SceneEntity]) -> Made:
    return f"foxglove/scene/{name}", SceneUpdate(entities=entities)
