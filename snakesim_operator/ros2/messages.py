"""The ROS messages that the bridge sends, field by field in the order of their definitions; rosbags encodes them.

Frames, units and conventions: REP 103. A stamp is in nanoseconds. Quaternions come as wxyz, and ROS has them as xyzw.
Definitions are those of Jazzy; a test compares the types' hashes with later distributions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from snakesim_operator.ros2.graph import RosType

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
OK, WARN, ERROR = 0, 1, 2  # levels of a diagnostic status
PLUMB_BOB = "plumb_bob"  # distortion model, here without distortion
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


def _sent(kind: RosType, *fields: Any) -> bytes:
    return bytes(STORE.serialize_cdr(made(kind.name, *fields), kind.name))


def made(name: str, *fields: Any) -> Any:
    """A ROS message, by its fields in their order."""
    known: Any = STORE.types
    return known[name](*fields)


def _time(stamp_ns: int) -> Any:
    return made("builtin_interfaces/msg/Time", min(stamp_ns // 10**9, LAST_SECOND), stamp_ns % 10**9)


def _header(stamp_ns: int, frame: str) -> Any:
    return made("std_msgs/msg/Header", _time(stamp_ns), frame)


def _vector(xyz: Triple) -> Any:
    return made("geometry_msgs/msg/Vector3", *xyz)


def _point(xyz: Triple) -> Any:
    return made("geometry_msgs/msg/Point", *xyz)


def _quaternion(wxyz: Wxyz) -> Any:
    return made("geometry_msgs/msg/Quaternion", *wxyz[1:], wxyz[0])


def _doubles(values: Sequence[float]) -> np.ndarray:
    return np.array(values, dtype=np.float64)


def _octets(raw: bytes) -> np.ndarray:
    return np.frombuffer(raw, dtype=np.uint8)


def clock(stamp_ns: int) -> bytes:
    """rosgraph_msgs/Clock."""
    return _sent(CLOCK, _time(stamp_ns))


def string(text: str) -> bytes:
    """std_msgs/String."""
    return _sent(STRING, text)


def numbers(label: str, values: Sequence[float]) -> bytes:
    """std_msgs/Float64MultiArray of one dimension."""
    dimension = made("std_msgs/msg/MultiArrayDimension", label, len(values), len(values))
    return _sent(NUMBERS, made("std_msgs/msg/MultiArrayLayout", [dimension], 0), _doubles(values))


def joint_state(
    stamp_ns: int,
    names: Sequence[str],
    angles_rad: Sequence[float],
    velocities_rad_s: Sequence[float],
    torques_nm: Sequence[float],
) -> bytes:
    """sensor_msgs/JointState; it has no frame."""
    numbers = map(_doubles, (angles_rad, velocities_rad_s, torques_nm))
    return _sent(JOINT_STATE, _header(stamp_ns, ""), names, *numbers)


def transforms(stamp_ns: int, all_of_them: Sequence[Transform]) -> bytes:
    """tf2_msgs/TFMessage."""
    return _sent(TRANSFORMS, [_transform(stamp_ns, one) for one in all_of_them])


def _transform(stamp_ns: int, one: Transform) -> Any:
    pose = made("geometry_msgs/msg/Transform", _vector(one.position_m), _quaternion(one.orientation_wxyz))
    return made("geometry_msgs/msg/TransformStamped", _header(stamp_ns, one.parent), one.child, pose)


def markers(stamp_ns: int, frame: str, shapes: Sequence[Marker]) -> bytes:
    """visualization_msgs/MarkerArray that replaces everything on its topic."""
    header = _header(stamp_ns, frame)
    cleared = _marker(header, 0, DELETE_ALL, Marker("", ARROW, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    return _sent(MARKERS, [cleared, *(_marker(header, number, ADD, shape) for number, shape in enumerate(shapes))])


def _marker(header: Any, number: int, action: int, shape: Marker) -> Any:
    pose = made("geometry_msgs/msg/Pose", _point(shape.position_m), _quaternion(shape.orientation_wxyz))
    colour = made("std_msgs/msg/ColorRGBA", *shape.rgba)
    until_replaced = made("builtin_interfaces/msg/Duration", 0, 0)
    drawn = (pose, _vector(shape.size_m), colour, until_replaced, False, [_point(xyz) for xyz in shape.points_m], [])
    no_texture = ("", made("sensor_msgs/msg/CompressedImage", _header(0, ""), "", _octets(b"")), [])
    no_mesh = ("", made("visualization_msgs/msg/MeshFile", "", _octets(b"")), False)
    what = (shape.group, number, shape.shape, action)
    return made("visualization_msgs/msg/Marker", header, *what, *drawn, *no_texture, "", *no_mesh)


def image(stamp_ns: int, frame: str, width: int, height: int, encoding: str, pixels: bytes) -> bytes:
    """sensor_msgs/Image. encoding: 16UC1 (mm), 32FC1 (m) or rgb8; rows without padding, little endian."""
    header = _header(stamp_ns, frame)
    return _sent(IMAGE, header, height, width, encoding, 0, len(pixels) // height, _octets(pixels))


def compressed_image(stamp_ns: int, frame: str, described: str, data: bytes) -> bytes:
    """sensor_msgs/CompressedImage. described: its `format`, as the plug-ins of image_transport read it."""
    return _sent(COMPRESSED_IMAGE, _header(stamp_ns, frame), described, _octets(data))


def imu(stamp_ns: int, frame: str, angular_velocity_rad_s: Triple, acceleration_m_s2: Triple) -> bytes:
    """sensor_msgs/Imu without orientation, which its covariance of -1 says; covariances of 0: unknown."""
    unknown, no_orientation = np.zeros(9), np.array([-1.0, *[0.0] * 8])
    turn, push = _vector(angular_velocity_rad_s), _vector(acceleration_m_s2)
    unturned = _quaternion((1.0, 0.0, 0.0, 0.0))
    return _sent(IMU, _header(stamp_ns, frame), unturned, no_orientation, turn, unknown, push, unknown)


def camera_info(stamp_ns: int, frame: str, width: int, height: int, k: tuple[float, float, float, float]) -> bytes:
    """sensor_msgs/CameraInfo of a camera without distortion. k: fx, fy, cx, cy in pixels."""
    fx, fy, cx, cy = k
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    projection = np.hstack([matrix, np.zeros((3, 1))])
    whole = made("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    numbers = (np.zeros(5), matrix.ravel(), np.eye(3).ravel(), projection.ravel())
    return _sent(CAMERA_INFO, _header(stamp_ns, frame), height, width, PLUMB_BOB, *numbers, 0, 0, whole)


def laser_scan(
    stamp_ns: int,
    frame: str,
    first_rad: float,
    step_rad: float,
    limits_m: tuple[float, float],
    range_m: Sequence[float],
) -> bytes:
    """sensor_msgs/LaserScan, all beams at one instant. range_m: infinite where there is nothing (REP 117)."""
    angles = (first_rad, first_rad + step_rad * (len(range_m) - 1), step_rad)
    beams, no_intensities = np.array(range_m, dtype=np.float32), np.array([], dtype=np.float32)
    return _sent(LASER_SCAN, _header(stamp_ns, frame), *angles, 0.0, 0.0, *limits_m, beams, no_intensities)


def diagnostics(stamp_ns: int, level: int, name: str, message: str, values: Mapping[str, str]) -> bytes:
    """diagnostic_msgs/DiagnosticArray with one status."""
    pairs = [made("diagnostic_msgs/msg/KeyValue", key, value) for key, value in values.items()]
    status = made("diagnostic_msgs/msg/DiagnosticStatus", level, name, message, name, pairs)
    return _sent(DIAGNOSTICS, _header(stamp_ns, ""), [status])


def six_doubles(twist: bytes) -> tuple[float, ...] | None:
    """A Twist's numbers, of either byte order; None: it is none."""
    try:
        found: Any = STORE.deserialize_cdr(twist, TWIST.name)
    except SerdeError:
        return None
    return tuple(getattr(part, axis) for part in (found.linear, found.angular) for axis in "xyz")
