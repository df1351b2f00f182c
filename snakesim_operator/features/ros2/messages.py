"""Types and parts of the ROS messages that the bridge sends, field by field as defined; rosbags encodes them.

Frames, units and conventions: REP 103. A stamp is in nanoseconds. Quaternions come as wxyz, and ROS has them as xyzw.
Definitions are those of Jazzy; a test compares the types' hashes with later distributions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from snakesim_operator.features.ros2.graph import RosType

STORE = get_typestore(Stores.ROS2_JAZZY)


def _type(name: str) -> RosType:
    return RosType(name, STORE.hash_rihs01(name))


JOINT_STATE = _type("sensor_msgs/msg/JointState")
TRANSFORMS = _type("tf2_msgs/msg/TFMessage")
MARKERS = _type("visualization_msgs/msg/MarkerArray")
IMAGE = _type("sensor_msgs/msg/Image")
COMPRESSED_IMAGE = _type("sensor_msgs/msg/CompressedImage")
IMU = _type("sensor_msgs/msg/Imu")
CAMERA_INFO = _type("sensor_msgs/msg/CameraInfo")
LASER_SCAN = _type("sensor_msgs/msg/LaserScan")
NUMBERS = _type("std_msgs/msg/Float64MultiArray")
STRING = _type("std_msgs/msg/String")
CLOCK = _type("rosgraph_msgs/msg/Clock")
TWIST = _type("geometry_msgs/msg/Twist")
DIAGNOSTICS = _type("diagnostic_msgs/msg/DiagnosticArray")

Triple = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Rgba = tuple[float, float, float, float]
ARROW, CUBE, SPHERE, CYLINDER = 0, 1, 2, 3  # types of a marker
ADD, DELETE_ALL = 0, 3  # actions of a marker
LAST_SECOND = 2**31 - 1  # of ROS; a robot's clock may say anything


@dataclass(frozen=True)
class Transform:
    """Pose of `child` in `parent`."""

    parent: str
    child: str
    position_m: Triple
    orientation_wxyz: Wxyz


@dataclass(frozen=True)
class Marker:
    """One shape to draw. Arrows have `points` (tail and tip); `size_m` then is shaft and head diameter, head length."""

    group: str
    shape: int
    size_m: Triple
    rgba: Rgba
    position_m: Triple = (0.0, 0.0, 0.0)
    orientation_wxyz: Wxyz = (1.0, 0.0, 0.0, 0.0)
    points_m: tuple[Triple, ...] = ()


def sent(kind: RosType, *fields: Any) -> bytes:
    """A message of this type in CDR, by its fields in their order."""
    return bytes(STORE.serialize_cdr(made(kind.name, *fields), kind.name))


def made(name: str, *fields: Any) -> Any:
    """A ROS message, by its fields in their order."""
    known: Any = STORE.types
    return known[name](*fields)


def _time(timestamp_ns: int) -> Any:
    return made("builtin_interfaces/msg/Time", min(timestamp_ns // 10**9, LAST_SECOND), timestamp_ns % 10**9)


def header(timestamp_ns: int, frame: str) -> Any:
    """Of a message. frame: empty for one that has none."""
    return made("std_msgs/msg/Header", _time(timestamp_ns), frame)


def vector(xyz: Triple) -> Any:
    """geometry_msgs/Vector3."""
    return made("geometry_msgs/msg/Vector3", *xyz)


def _point(xyz: Triple) -> Any:
    return made("geometry_msgs/msg/Point", *xyz)


def quaternion(wxyz: Wxyz) -> Any:
    """geometry_msgs/Quaternion."""
    return made("geometry_msgs/msg/Quaternion", *wxyz[1:], wxyz[0])


def _octets(raw: bytes) -> np.ndarray:
    return np.frombuffer(raw, dtype=np.uint8)


def clock(timestamp_ns: int) -> bytes:
    """rosgraph_msgs/Clock."""
    return sent(CLOCK, _time(timestamp_ns))


def string(text: str) -> bytes:
    """std_msgs/String."""
    return sent(STRING, text)


def transforms(timestamp_ns: int, all_of_them: Sequence[Transform]) -> bytes:
    """tf2_msgs/TFMessage."""
    return sent(TRANSFORMS, [_transform(timestamp_ns, one) for one in all_of_them])


def _transform(timestamp_ns: int, one: Transform) -> Any:
    pose = made("geometry_msgs/msg/Transform", vector(one.position_m), quaternion(one.orientation_wxyz))
    return made("geometry_msgs/msg/TransformStamped", header(timestamp_ns, one.parent), one.child, pose)


def markers(timestamp_ns: int, frame: str, shapes: Sequence[Marker]) -> bytes:
    """visualization_msgs/MarkerArray that replaces everything on its topic."""
    head = header(timestamp_ns, frame)
    cleared = _marker(head, 0, DELETE_ALL, Marker("", ARROW, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    return sent(MARKERS, [cleared, *(_marker(head, number, ADD, shape) for number, shape in enumerate(shapes))])


def _marker(head: Any, number: int, action: int, shape: Marker) -> Any:
    pose = made("geometry_msgs/msg/Pose", _point(shape.position_m), quaternion(shape.orientation_wxyz))
    color = made("std_msgs/msg/ColorRGBA", *shape.rgba)
    until_replaced = made("builtin_interfaces/msg/Duration", 0, 0)
    drawn = (pose, vector(shape.size_m), color, until_replaced, False, [_point(xyz) for xyz in shape.points_m], [])
    no_texture = ("", made("sensor_msgs/msg/CompressedImage", header(0, ""), "", _octets(b"")), [])
    no_mesh = ("", made("visualization_msgs/msg/MeshFile", "", _octets(b"")), False)
    what = (shape.group, number, shape.shape, action)
    return made("visualization_msgs/msg/Marker", head, *what, *drawn, *no_texture, "", *no_mesh)


def image(timestamp_ns: int, frame: str, width: int, height: int, encoding: str, pixels: bytes) -> bytes:
    """sensor_msgs/Image. encoding: 16UC1 (mm), 32FC1 (m) or rgb8; rows without padding, little endian."""
    size = (height, width, encoding, 0, len(pixels) // height)
    return sent(IMAGE, header(timestamp_ns, frame), *size, _octets(pixels))


def compressed_image(timestamp_ns: int, frame: str, described: str, data: bytes) -> bytes:
    """sensor_msgs/CompressedImage. described: its `format`, as the plug-ins of image_transport read it."""
    return sent(COMPRESSED_IMAGE, header(timestamp_ns, frame), described, _octets(data))


def six_doubles(twist: bytes) -> tuple[float, ...] | None:
    """A Twist's numbers, of either byte order; None: it is none."""
    try:
        found: Any = STORE.deserialize_cdr(twist, TWIST.name)
    except SerdeError:
        return None
    return tuple(getattr(part, axis) for part in (found.linear, found.angular) for axis in "xyz")
