"""Topics for Foxglove, PlotJuggler and Rerun: their names, the types of their messages, and the schemas of the types.

Numbers come at the rate of the messages that they are made of: `/ROBOT/joint_states`, `/ROBOT/joint_references`,
`/ROBOT/contact_forces`, `/ROBOT/state`, and `/ROBOT/log` of its changes. What is drawn comes a few times a second:
`/ROBOT/tf` (a chain: each link in the frame of the one behind it), `/ROBOT/pose`, `/ROBOT/scene/...` (body, obstacles,
map, forces, path), `/ROBOT/CAMERA/depth/image_raw` and `color`.
Forces, state and custom samples are JSON with a schema, all else is Foxglove's protobuf.
"""

import re
from functools import cache
from typing import Any, NamedTuple

import msgspec
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as Protobuf

from snakesim_hal.wire.messages import CustomSample
from snakesim_operator.recording.foxglove_messages.state_messages import (
    ContactForcesMessage,
    RobotStateMessage,
)

JsonMessage = RobotStateMessage | ContactForcesMessage | CustomSample
MessageType = (
    type[Protobuf] | type[RobotStateMessage] | type[ContactForcesMessage] | type[CustomSample]
)

COMMON_TOPICS: dict[
    str, MessageType
] = {  # below the robot's name; every robot may have them, unlike cameras
    "tf": FrameTransforms,
    "joint_states": JointStates,
    "joint_references": JointStates,
    "contact_forces": ContactForcesMessage,
    "state": RobotStateMessage,
    "log": Log,
    "pose": PoseInFrame,
    "scene/body": SceneUpdate,
    "scene/obstacles": SceneUpdate,
    "scene/map": SceneUpdate,
    "scene/forces": SceneUpdate,
    "scene/path": SceneUpdate,
}


class FoxgloveMessage(NamedTuple):
    """One message for Foxglove."""

    topic: str
    message_type: MessageType
    payload: bytes


class FoxgloveSchema(NamedTuple):
    """How a type of message is encoded."""

    name: str
    message_encoding: str
    schema_encoding: str
    data: bytes


def make_name_part(text: str) -> str:
    """Return a text as a part of a topic: every character that ROS does not allow in a name becomes _."""
    return re.sub(r"\W", "_", text, flags=re.ASCII)


@cache
def make_topic(robot: str, name: str) -> str:
    """Return a topic as ROS would name it.

    Args:
        robot: Name of the robot.
        name: Name below that of the robot, such as `joint_states`.
    """
    return f"/{make_name_part(robot)}/{name}"


@cache
def make_schema(message_type: MessageType) -> FoxgloveSchema:
    """Return the schema of a message type as MCAP requires it."""
    if issubclass(message_type, RobotStateMessage | ContactForcesMessage | CustomSample):
        return _make_json_schema(message_type)
    return _make_protobuf_schema(message_type)


def _make_json_schema(message_type: type[JsonMessage]) -> FoxgloveSchema:
    name = message_type.__name__
    schema = msgspec.json.schema(message_type)["$defs"][name]
    return FoxgloveSchema(
        f"snakesim.shown.{name}", "json", "jsonschema", msgspec.json.encode(schema)
    )


def _make_protobuf_schema(message_type: type[Protobuf]) -> FoxgloveSchema:
    """Return the schema of a protobuf type: its file, behind all files that it imports."""
    files: dict[str, Any] = {}

    def add_file(file: Any) -> None:
        for imported in file.dependencies:
            add_file(imported)
        files.setdefault(file.name, file)

    add_file(message_type.DESCRIPTOR.file)
    file_set = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(file_set.file.add())
    name = message_type.DESCRIPTOR.full_name
    return FoxgloveSchema(name, "protobuf", "protobuf", file_set.SerializeToString())
