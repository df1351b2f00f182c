"""Builds and encodes the ROS messages that the bridge sends, field by field as defined; rosbags encodes them.

Frames, units and conventions follow REP 103. A timestamp is in nanoseconds. Quaternions come as wxyz, and ROS has
them as xyzw. The definitions are those of Jazzy; a test compares the types' hashes with later distributions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from snakesim_operator.features.ros2.graph import RosType

TYPE_STORE = get_typestore(Stores.ROS2_JAZZY)


def _define_type(name: str) -> RosType:
    return RosType(name, TYPE_STORE.hash_rihs01(name))


JOINT_STATE = _define_type("sensor_msgs/msg/JointState")
TRANSFORMS = _define_type("tf2_msgs/msg/TFMessage")
MARKERS = _define_type("visualization_msgs/msg/MarkerArray")
IMAGE = _define_type("sensor_msgs/msg/Image")
COMPRESSED_IMAGE = _define_type("sensor_msgs/msg/CompressedImage")
IMU = _define_type("sensor_msgs/msg/Imu")
CAMERA_INFO = _define_type("sensor_msgs/msg/CameraInfo")
LASER_SCAN = _define_type("sensor_msgs/msg/LaserScan")
FLOAT64_ARRAY = _define_type("std_msgs/msg/Float64MultiArray")
STRING = _define_type("std_msgs/msg/String")
CLOCK = _define_type("rosgraph_msgs/msg/Clock")
TWIST = _define_type("geometry_msgs/msg/Twist")
WRENCH = _define_type("geometry_msgs/msg/WrenchStamped")
DIAGNOSTICS = _define_type("diagnostic_msgs/msg/DiagnosticArray")

Triple = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Rgba = tuple[float, float, float, float]

# Types of a visualization_msgs/Marker.
ARROW = 0
CUBE = 1
SPHERE = 2
CYLINDER = 3

# Actions of a visualization_msgs/Marker.
ADD = 0
DELETE_ALL = 3

MAX_TIME_S = 2**31 - 1  # builtin_interfaces/Time has 32 bits; a robot's clock may have any value


@dataclass(frozen=True)
class RosTransform:
    """Pose of `child` in `parent`."""

    parent: str
    child: str
    position_m: Triple
    orientation_wxyz: Wxyz


@dataclass(frozen=True)
class RosMarker:
    """One shape to draw. Arrows have `points` (tail and tip); `size_m` then is shaft and head diameter, head length."""

    group: str
    shape: int
    size_m: Triple
    rgba: Rgba
    position_m: Triple = (0.0, 0.0, 0.0)
    orientation_wxyz: Wxyz = (1.0, 0.0, 0.0, 0.0)
    points_m: tuple[Triple, ...] = ()


def make_message(type_name: str, *fields: Any) -> Any:
    """Return a ROS message object with these fields, in the order of their definition."""
    message_types: Any = TYPE_STORE.types
    return message_types[type_name](*fields)


def encode_message(ros_type: RosType, *fields: Any) -> bytes:
    """Return a message in CDR with these fields, in the order of their definition."""
    message = make_message(ros_type.name, *fields)
    return bytes(TYPE_STORE.serialize_cdr(message, ros_type.name))


def _make_time(timestamp_ns: int) -> Any:
    seconds = min(timestamp_ns // 10**9, MAX_TIME_S)
    nanoseconds = timestamp_ns % 10**9
    return make_message("builtin_interfaces/msg/Time", seconds, nanoseconds)


def make_header(timestamp_ns: int, frame: str) -> Any:
    """Make the header of a message. `frame` is empty for a message that belongs to no frame."""
    return make_message("std_msgs/msg/Header", _make_time(timestamp_ns), frame)


def make_vector(xyz: Triple) -> Any:
    """Return a geometry_msgs/Vector3."""
    return make_message("geometry_msgs/msg/Vector3", *xyz)


def _make_point(xyz: Triple) -> Any:
    return make_message("geometry_msgs/msg/Point", *xyz)


def make_quaternion(wxyz: Wxyz) -> Any:
    """Return a geometry_msgs/Quaternion, which has its fields in the order xyzw."""
    w, x, y, z = wxyz
    return make_message("geometry_msgs/msg/Quaternion", x, y, z, w)


def _make_octets(data: bytes) -> np.ndarray:
    return np.frombuffer(data, dtype=np.uint8)


def encode_clock(timestamp_ns: int) -> bytes:
    """Return a rosgraph_msgs/Clock in CDR."""
    return encode_message(CLOCK, _make_time(timestamp_ns))


def encode_string(text: str) -> bytes:
    """Return a std_msgs/String in CDR."""
    return encode_message(STRING, text)


def encode_transforms(timestamp_ns: int, transforms: Sequence[RosTransform]) -> bytes:
    """Return a tf2_msgs/TFMessage in CDR."""
    stamped = [_make_stamped_transform(timestamp_ns, transform) for transform in transforms]
    return encode_message(TRANSFORMS, stamped)


def _make_stamped_transform(timestamp_ns: int, transform: RosTransform) -> Any:
    translation = make_vector(transform.position_m)
    rotation = make_quaternion(transform.orientation_wxyz)
    pose = make_message("geometry_msgs/msg/Transform", translation, rotation)
    header = make_header(timestamp_ns, transform.parent)
    return make_message("geometry_msgs/msg/TransformStamped", header, transform.child, pose)


def encode_markers(timestamp_ns: int, frame: str, shapes: Sequence[RosMarker]) -> bytes:
    """Return a visualization_msgs/MarkerArray in CDR that replaces everything on its topic."""
    header = make_header(timestamp_ns, frame)
    nothing = RosMarker("", ARROW, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    markers = [_make_marker(header, 0, DELETE_ALL, nothing)]
    for number, shape in enumerate(shapes):
        markers.append(_make_marker(header, number, ADD, shape))
    return encode_message(MARKERS, markers)


def _make_marker(header: Any, marker_id: int, action: int, shape: RosMarker) -> Any:
    """Make a visualization_msgs/Marker; its fields are in the order of their definition.

    Args:
        header: Header of the message, with time and frame.
        marker_id: Number of the marker in its group.
        action: ADD or DELETE_ALL, as the message defines them.
        shape: Shape, size in m, pose and color.
    """
    position = _make_point(shape.position_m)
    orientation = make_quaternion(shape.orientation_wxyz)
    until_replaced = make_message("builtin_interfaces/msg/Duration", 0, 0)
    no_image = make_message(
        "sensor_msgs/msg/CompressedImage", make_header(0, ""), "", _make_octets(b"")
    )
    no_mesh = make_message("visualization_msgs/msg/MeshFile", "", _make_octets(b""))
    return make_message(
        "visualization_msgs/msg/Marker",
        header,
        shape.group,  # ns
        marker_id,  # id
        shape.shape,  # type
        action,
        make_message("geometry_msgs/msg/Pose", position, orientation),
        make_vector(shape.size_m),  # scale
        make_message("std_msgs/msg/ColorRGBA", *shape.rgba),
        until_replaced,  # lifetime
        False,  # frame_locked
        [_make_point(point) for point in shape.points_m],
        [],  # colors
        "",  # texture_resource
        no_image,  # texture
        [],  # uv_coordinates
        "",  # text
        "",  # mesh_resource
        no_mesh,  # mesh_file
        False,  # mesh_use_embedded_materials
    )


def encode_image(
    timestamp_ns: int, frame: str, width: int, height: int, encoding: str, pixels: bytes
) -> bytes:
    """Encode a camera image as a sensor_msgs/Image in CDR.

    Args:
        timestamp_ns: Time of the image.
        frame: Optical frame of the camera.
        width: Width in pixels.
        height: Height in pixels.
        encoding: 16UC1 (mm), 32FC1 (m) or rgb8.
        pixels: Rows without padding, little endian.
    """
    is_big_endian = 0
    row_bytes = len(pixels) // height
    return encode_message(
        IMAGE,
        make_header(timestamp_ns, frame),
        height,
        width,
        encoding,
        is_big_endian,
        row_bytes,
        _make_octets(pixels),
    )


def encode_compressed_image(timestamp_ns: int, frame: str, format_: str, data: bytes) -> bytes:
    """Encode a sensor_msgs/CompressedImage in CDR. `format_` is the text that plug-ins of image_transport read."""
    return encode_message(
        COMPRESSED_IMAGE, make_header(timestamp_ns, frame), format_, _make_octets(data)
    )


def decode_twist(payload: bytes) -> tuple[float, ...] | None:
    """Return the components of a Twist in CDR of either byte order: linear xyz, then angular xyz.

    Returns:
        Six numbers, or None if the payload is no Twist.
    """
    try:
        twist: Any = TYPE_STORE.deserialize_cdr(payload, TWIST.name)
    except SerdeError:
        return None
    linear = twist.linear
    angular = twist.angular
    return (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
