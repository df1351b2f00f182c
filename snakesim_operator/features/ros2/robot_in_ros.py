"""What the robot says, as ROS messages: pure translation, with the frames of `frames.py`."""

import struct
from collections.abc import Iterable

import numpy as np

from snakesim_hal.wire.messages import (
    ColorImage,
    DepthImage,
    Imu,
    JointState,
    Obstacle,
    OwnSample,
    Ranges,
    Status,
    World,
    WorldContact,
)
from snakesim_hal.wire.own_sample import OwnKind
from snakesim_operator.base.png import png
from snakesim_operator.features.ros2 import messages as ros
from snakesim_operator.features.ros2.messages import Marker, Rgba, Triple

METRES_PER_NEWTON = 0.01  # length of a force arrow
ARROW_M: Triple = (0.008, 0.016, 0.02)  # diameter of shaft and head, length of the head
CONTACT: Rgba = (0.85, 0.2, 0.1, 1.0)
FELT: Rgba = (0.9, 0.55, 0.1, 1.0)
SEEN: Rgba = (0.3, 0.5, 0.75, 1.0)
OK, WARN, ERROR = 0, 1, 2  # levels of a diagnostic status
PLUMB_BOB = "plumb_bob"  # distortion model, here without distortion
MILLIMETRE = 0.001
MOST_COUNTS = 65535  # of 16 bits
INVERSE_DEPTH_UNUSED = struct.pack("<i2f", 0, 0.0, 0.0)  # format and two parameters, for depth in float alone


def joint_state(timestamp_ns: int, names: list[str], joints: JointState) -> bytes:
    """sensor_msgs/JointState, without a frame. Joints that are not valid are left out: it may name any subset."""
    kept = [i for i, valid in enumerate(joints.valid) if valid]
    series = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
    numbers = (np.array([values[i] for i in kept], dtype=np.float64) for values in series)
    return ros.sent(ros.JOINT_STATE, ros.header(timestamp_ns, ""), [names[i] for i in kept], *numbers)


def contact_markers(contacts: Iterable[WorldContact]) -> list[Marker]:
    """An arrow for the force on the body at each contact."""
    return [
        Marker("contacts", ros.ARROW, ARROW_M, CONTACT, points_m=(contact.position_w, _tip(contact)))
        for contact in contacts
    ]


def _tip(contact: WorldContact) -> Triple:
    (x, y, z), (fx, fy, fz) = contact.position_w, contact.force_w
    return (x + METRES_PER_NEWTON * fx, y + METRES_PER_NEWTON * fy, z + METRES_PER_NEWTON * fz)


def obstacle_markers(world: World) -> list[Marker]:
    """The obstacles that guidance knows; opaque ones are certain, those felt are orange."""
    return [_obstacle(one) for one in world.obstacles]


def _obstacle(one: Obstacle) -> Marker:
    across = 2 * one.radius_m
    shape, size = {
        "cylinder": (ros.CYLINDER, (across, across, one.height_m)),
        "sphere": (ros.SPHERE, (across, across, across)),
        "box": (ros.CUBE, (2 * one.half_size_m[0], 2 * one.half_size_m[1], 2 * one.half_size_m[2])),
    }[one.shape]
    turned = (float(np.cos(one.yaw_rad / 2)), 0.0, 0.0, float(np.sin(one.yaw_rad / 2)))
    red, green, blue, _ = FELT if one.felt else SEEN
    opacity = 0.2 + 0.8 * one.confidence
    return Marker("obstacles", shape, size, (red, green, blue, opacity), one.position_w, turned)


def depth_image(timestamp_ns: int, frame: str, seen: DepthImage) -> bytes:
    """16UC1 in millimetres, 0 for nothing; of another scale 32FC1 in metres, NaN for nothing (REP 118)."""
    if seen.scale_m == MILLIMETRE:
        return ros.image(timestamp_ns, frame, seen.width, seen.height, "16UC1", seen.depth)
    counts = np.frombuffer(seen.depth, dtype="<u2")
    metres = np.where(counts == 0, np.nan, counts * seen.scale_m).astype("<f4")
    return ros.image(timestamp_ns, frame, seen.width, seen.height, "32FC1", metres.tobytes())


def color_image(timestamp_ns: int, frame: str, seen: ColorImage) -> bytes:
    """As rgb8."""
    return ros.image(timestamp_ns, frame, seen.width, seen.height, "rgb8", seen.rgb)


def compressed_depth(timestamp_ns: int, frame: str, seen: DepthImage) -> bytes:
    """As a PNG of 16 bits in millimetres, 0 for nothing, behind 12 bytes of parameters that its reader skips."""
    millimetres = np.frombuffer(seen.depth, dtype="<u2") * (seen.scale_m / MILLIMETRE)
    counts = np.where(millimetres > MOST_COUNTS, 0, np.rint(millimetres)).astype(">u2")
    picture = png(seen.width, seen.height, counts.tobytes(), bits=16, color=False)
    return ros.compressed_image(timestamp_ns, frame, "16UC1; compressedDepth png", INVERSE_DEPTH_UNUSED + picture)


def compressed_color(timestamp_ns: int, frame: str, seen: ColorImage) -> bytes:
    """As a PNG of 8 bits, without loss. OpenCV reads it as bgr8, which `format` says."""
    picture = png(seen.width, seen.height, seen.rgb, bits=8, color=True)
    return ros.compressed_image(timestamp_ns, frame, "rgb8; png compressed bgr8", picture)


def imu(timestamp_ns: int, frame: str, seen: Imu, entry: int) -> bytes:
    """sensor_msgs/Imu of one link; acceleration is the specific force, as REP 145 wants it.

    Without orientation, which its covariance of -1 says; covariances of 0: unknown.
    """
    unknown, no_orientation = np.zeros(9), np.array([-1.0, *[0.0] * 8])
    turn, push = ros.vector(seen.angular_velocity_rad_s[entry]), ros.vector(seen.acceleration_m_s2[entry])
    unturned = ros.quaternion((1.0, 0.0, 0.0, 0.0))
    return ros.sent(ros.IMU, ros.header(timestamp_ns, frame), unturned, no_orientation, turn, unknown, push, unknown)


def camera_info(timestamp_ns: int, frame: str, seen: DepthImage | ColorImage) -> bytes:
    """sensor_msgs/CameraInfo of either image, of a camera without distortion."""
    matrix = np.array([[seen.fx_px, 0.0, seen.cx_px], [0.0, seen.fy_px, seen.cy_px], [0.0, 0.0, 1.0]])
    projection = np.hstack([matrix, np.zeros((3, 1))])
    whole = ros.made("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    numbers = (np.zeros(5), matrix.ravel(), np.eye(3).ravel(), projection.ravel())
    size = (seen.height, seen.width, PLUMB_BOB)
    return ros.sent(ros.CAMERA_INFO, ros.header(timestamp_ns, frame), *size, *numbers, 0, 0, whole)


def laser_scan(timestamp_ns: int, frame: str, seen: Ranges) -> bytes:
    """sensor_msgs/LaserScan, all beams at one instant. Those without a return are infinite (REP 117)."""
    beams = np.array([np.inf if range_m is None else range_m for range_m in seen.range_m], dtype=np.float32)
    last_rad = seen.angle_min_rad + seen.angle_step_rad * (len(beams) - 1)
    angles, limits = (seen.angle_min_rad, last_rad, seen.angle_step_rad), (seen.range_min_m, seen.range_max_m)
    no_intensities = np.array([], dtype=np.float32)
    header = ros.header(timestamp_ns, frame)
    return ros.sent(ros.LASER_SCAN, header, *angles, 0.0, 0.0, *limits, beams, no_intensities)


def numbers(kind: OwnKind, field: str, _timestamp_ns: int, _frame: str, sample: OwnSample) -> bytes:
    """std_msgs/Float64MultiArray of one field of a sensor's own message, of one dimension with its name and unit."""
    found = [value for name, value in kind.numbers(sample).items() if name.partition(".")[0] == field]
    label = f"{field} [{kind.units[field]}]"
    dimension = ros.made("std_msgs/msg/MultiArrayDimension", label, len(found), len(found))
    layout = ros.made("std_msgs/msg/MultiArrayLayout", [dimension], 0)
    return ros.sent(ros.NUMBERS, layout, np.array(found, dtype=np.float64))


def diagnostics(timestamp_ns: int, status: Status) -> bytes:
    """diagnostic_msgs/DiagnosticArray with one status: the robot's state and its reason."""
    stopped = status.lifecycle in ("fault", "estop")
    level = ERROR if stopped else WARN if status.faults or status.isolated or status.derated else OK
    values = {
        "lifecycle": status.lifecycle,
        "backend": status.backend,
        "lease holder": status.lease_holder or "free",
        "rate_hz": f"{status.rate_hz:g}",
        "overruns": str(status.overruns),
        "isolated joints": ", ".join(status.isolated) or "none",
        **{f"fault {i}": f"{fault.what}: {fault.cause}" for i, fault in enumerate(status.faults)},
    }
    pairs = [ros.made("diagnostic_msgs/msg/KeyValue", key, value) for key, value in values.items()]
    words = f"{status.lifecycle}: {status.why}"
    said = ros.made("diagnostic_msgs/msg/DiagnosticStatus", level, status.robot, words, status.robot, pairs)
    return ros.sent(ros.DIAGNOSTICS, ros.header(timestamp_ns, ""), [said])
