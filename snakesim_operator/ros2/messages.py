"""The ROS messages that the bridge sends, field by field in the order of their definitions, and the types' hashes.

Frames, units and conventions: REP 103. A stamp is in nanoseconds. Quaternions come as wxyz, and ROS has them as xyzw.
The hashes are the same in Jazzy, Kilted and Rolling; a test computes them from the definitions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from snakesim_operator.ros2.cdr import Cdr
from snakesim_operator.ros2.graph import RosType

JOINT_STATE = RosType("sensor_msgs/msg/JointState", "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e")
TRANSFORMS = RosType("tf2_msgs/msg/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087")
MARKERS = RosType(
    "visualization_msgs/msg/MarkerArray", "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf"
)
IMAGE = RosType("sensor_msgs/msg/Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47")
CAMERA_INFO = RosType("sensor_msgs/msg/CameraInfo", "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275")
LASER_SCAN = RosType("sensor_msgs/msg/LaserScan", "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828")
STRING = RosType("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
CLOCK = RosType("rosgraph_msgs/msg/Clock", "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564")
TWIST = RosType("geometry_msgs/msg/Twist", "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a")
DIAGNOSTICS = RosType(
    "diagnostic_msgs/msg/DiagnosticArray", "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
)
TYPES = (JOINT_STATE, TRANSFORMS, MARKERS, IMAGE, CAMERA_INFO, LASER_SCAN, STRING, CLOCK, TWIST, DIAGNOSTICS)

Triple = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Rgba = tuple[float, float, float, float]
ARROW, CUBE, SPHERE, CYLINDER = 0, 1, 2, 3  # types of a marker
ADD, DELETE_ALL = 0, 3  # actions of a marker
OK, WARN, ERROR = 0, 1, 2  # levels of a diagnostic status
PLUMB_BOB = "plumb_bob"  # distortion model, here without distortion
LAST_SECOND = 2**31 - 1  # of ROS; a robot's clock may say anything
ROW_MAJOR_UNIT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


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


def _time(cdr: Cdr, stamp_ns: int) -> Cdr:
    return cdr.numbers("i", min(stamp_ns // 10**9, LAST_SECOND)).numbers("I", stamp_ns % 10**9)


def _header(cdr: Cdr, stamp_ns: int, frame: str) -> Cdr:
    return _time(cdr, stamp_ns).text(frame)


def _pose(cdr: Cdr, position_m: Triple, orientation_wxyz: Wxyz) -> Cdr:
    w, x, y, z = orientation_wxyz
    return cdr.numbers("d", *position_m, x, y, z, w)


def clock(stamp_ns: int) -> bytes:
    """rosgraph_msgs/Clock."""
    return _time(Cdr(), stamp_ns).done()


def string(text: str) -> bytes:
    """std_msgs/String."""
    return Cdr().text(text).done()


def joint_state(
    stamp_ns: int,
    names: Sequence[str],
    angles_rad: Sequence[float],
    velocities_rad_s: Sequence[float],
    torques_nm: Sequence[float],
) -> bytes:
    """sensor_msgs/JointState; it has no frame."""
    cdr = _header(Cdr(), stamp_ns, "").texts(names)
    return cdr.sequence("d", angles_rad).sequence("d", velocities_rad_s).sequence("d", torques_nm).done()


def transforms(stamp_ns: int, all_of_them: Sequence[Transform]) -> bytes:
    """tf2_msgs/TFMessage."""
    cdr = Cdr().numbers("I", len(all_of_them))
    for one in all_of_them:
        _header(cdr, stamp_ns, one.parent).text(one.child)
        _pose(cdr, one.position_m, one.orientation_wxyz)
    return cdr.done()


def markers(stamp_ns: int, frame: str, shapes: Sequence[Marker]) -> bytes:
    """visualization_msgs/MarkerArray that replaces everything on its topic."""
    cdr = Cdr().numbers("I", len(shapes) + 1)
    _marker(cdr, stamp_ns, frame, 0, DELETE_ALL, Marker("", ARROW, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    for number, shape in enumerate(shapes):
        _marker(cdr, stamp_ns, frame, number, ADD, shape)
    return cdr.done()


def _marker(cdr: Cdr, stamp_ns: int, frame: str, number: int, action: int, shape: Marker) -> None:
    _header(cdr, stamp_ns, frame).text(shape.group).numbers("i", number, shape.shape, action)
    _pose(cdr, shape.position_m, shape.orientation_wxyz).numbers("d", *shape.size_m).numbers("f", *shape.rgba)
    cdr.numbers("i", 0).numbers("I", 0)  # lifetime: until it is replaced
    cdr.numbers("?", False)  # not locked to its frame
    cdr.numbers("I", len(shape.points_m)).numbers("d", *(number for point in shape.points_m for number in point))
    cdr.numbers("I", 0)  # colours of the points
    _header(cdr.text(""), 0, "").text("").octets(b"")  # no texture: resource, then a compressed image
    cdr.numbers("I", 0)  # its coordinates
    cdr.text("").text("").text("").octets(b"").numbers("?", False)  # text; mesh: resource, file, materials


def image(stamp_ns: int, frame: str, width: int, height: int, encoding: str, pixels: bytes) -> bytes:
    """sensor_msgs/Image. encoding: 16UC1 (mm), 32FC1 (m) or rgb8; rows without padding, little endian."""
    cdr = _header(Cdr(), stamp_ns, frame).numbers("I", height, width).text(encoding).numbers("B", 0)
    return cdr.numbers("I", len(pixels) // height).octets(pixels).done()


def camera_info(stamp_ns: int, frame: str, width: int, height: int, k: tuple[float, float, float, float]) -> bytes:
    """sensor_msgs/CameraInfo of a camera without distortion. k: fx, fy, cx, cy in pixels."""
    fx, fy, cx, cy = k
    cdr = _header(Cdr(), stamp_ns, frame).numbers("I", height, width).text(PLUMB_BOB).sequence("d", [0.0] * 5)
    cdr.numbers("d", fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0).numbers("d", *ROW_MAJOR_UNIT)
    cdr.numbers("d", fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    return cdr.numbers("I", 0, 0, 0, 0, 0, 0).numbers("?", False).done()  # binning; region of interest: all of it


def laser_scan(
    stamp_ns: int,
    frame: str,
    first_rad: float,
    step_rad: float,
    limits_m: tuple[float, float],
    range_m: Sequence[float],
) -> bytes:
    """sensor_msgs/LaserScan, all beams at one instant. range_m: infinite where there is nothing (REP 117)."""
    last_rad = first_rad + step_rad * (len(range_m) - 1)
    cdr = _header(Cdr(), stamp_ns, frame).numbers("f", first_rad, last_rad, step_rad, 0.0, 0.0, *limits_m)
    return cdr.sequence("f", range_m).numbers("I", 0).done()


def diagnostics(stamp_ns: int, level: int, name: str, message: str, values: Mapping[str, str]) -> bytes:
    """diagnostic_msgs/DiagnosticArray with one status."""
    cdr = _header(Cdr(), stamp_ns, "").numbers("I", 1).numbers("B", level).text(name).text(message).text(name)
    cdr.numbers("I", len(values))
    for key, value in values.items():
        cdr.text(key).text(value)
    return cdr.done()
