"""Translates messages of the robot into ROS messages in CDR. The names of frames come from `frames.py`."""

import struct
from collections.abc import Iterable

import numpy as np

from snakesim_hal.wire.custom_sample import CustomMessage
from snakesim_hal.wire.messages import (
    ColorImage,
    CustomSample,
    DepthImage,
    Imu,
    JointState,
    KnownObstacle,
    RangeScan,
    RobotStatus,
    WorldContact,
    WorldModel,
)
from snakesim_operator.base.png import encode_png
from snakesim_operator.features.ros2 import messages as ros
from snakesim_operator.features.ros2.messages import Rgba, RosMarker, Triple

# How contacts and obstacles are drawn.
ARROW_M_PER_N = 0.01  # length of a force arrow
ARROW_SIZE_M: Triple = (0.008, 0.016, 0.02)  # diameter of shaft and head, length of the head
CONTACT_COLOR: Rgba = (0.85, 0.2, 0.1, 1.0)
TOUCHED_COLOR: Rgba = (0.9, 0.55, 0.1, 1.0)  # obstacles that the robot has touched
SEEN_COLOR: Rgba = (0.3, 0.5, 0.75, 1.0)  # obstacles that its sensors have measured
MIN_OPACITY = 0.2  # an obstacle of no confidence is still visible
OPACITY_RANGE = 0.8

# Levels of a diagnostic_msgs/DiagnosticStatus.
OK = 0
WARN = 1
ERROR = 2

# Images.
PLUMB_BOB = "plumb_bob"  # distortion model; all its coefficients are 0 here
MILLIMETER_M = 0.001
MAX_DEPTH_COUNTS = 65535  # 16 bits
# Format and two parameters, for depth in float alone.
INVERSE_DEPTH_UNUSED = struct.pack("<i2f", 0, 0.0, 0.0)


def encode_joint_state(timestamp_ns: int, names: list[str], joints: JointState) -> bytes:
    """Encode a joint state as a sensor_msgs/JointState without a frame.

    Joints whose state is not valid are left out, because a JointState may name any subset of the joints.

    Args:
        timestamp_ns: Time of the state in ROS.
        names: Names of the joints, tail to head.
        joints: The state.
    """
    valid_joints = [i for i, is_valid in enumerate(joints.valid) if is_valid]
    valid_names = [names[i] for i in valid_joints]
    angles_rad = [joints.angle_rad[i] for i in valid_joints]
    velocities_rad_s = [joints.velocity_rad_s[i] for i in valid_joints]
    torques_nm = [joints.torque_nm[i] for i in valid_joints]
    return ros.encode_message(
        ros.JOINT_STATE,
        ros.make_header(timestamp_ns, ""),
        valid_names,
        np.array(angles_rad, dtype=np.float64),
        np.array(velocities_rad_s, dtype=np.float64),
        np.array(torques_nm, dtype=np.float64),
    )


def make_contact_markers(contacts: Iterable[WorldContact]) -> list[RosMarker]:
    """Return an arrow for the force on the body at each contact."""
    markers: list[RosMarker] = []
    for contact in contacts:
        points = (contact.position_w, _find_arrow_tip(contact))
        markers.append(
            RosMarker("contacts", ros.ARROW, ARROW_SIZE_M, CONTACT_COLOR, points_m=points)
        )
    return markers


def _find_arrow_tip(contact: WorldContact) -> Triple:
    x, y, z = contact.position_w
    fx, fy, fz = contact.force_w
    return (x + ARROW_M_PER_N * fx, y + ARROW_M_PER_N * fy, z + ARROW_M_PER_N * fz)


def make_obstacle_markers(world: WorldModel) -> list[RosMarker]:
    """Return the obstacles of the world model: opaque if they are certain, orange if they were touched."""
    return [_make_obstacle_marker(obstacle) for obstacle in world.obstacles]


def _make_obstacle_marker(obstacle: KnownObstacle) -> RosMarker:
    """Make a marker with the shape of an obstacle; its color shows contact, and its opacity the confidence."""
    diameter_m = 2 * obstacle.radius_m
    match obstacle.shape:
        case "cylinder":
            shape = ros.CYLINDER
            size_m = (diameter_m, diameter_m, obstacle.height_m)
        case "sphere":
            shape = ros.SPHERE
            size_m = (diameter_m, diameter_m, diameter_m)
        case "box":
            half_x_m, half_y_m, half_z_m = obstacle.half_size_m
            shape = ros.CUBE
            size_m = (2 * half_x_m, 2 * half_y_m, 2 * half_z_m)
    half_yaw_rad = obstacle.yaw_rad / 2
    orientation_wxyz = (float(np.cos(half_yaw_rad)), 0.0, 0.0, float(np.sin(half_yaw_rad)))
    color = TOUCHED_COLOR if obstacle.touched else SEEN_COLOR
    red, green, blue, _ = color
    opacity = MIN_OPACITY + OPACITY_RANGE * obstacle.confidence
    rgba = (red, green, blue, opacity)
    return RosMarker("obstacles", shape, size_m, rgba, obstacle.position_w, orientation_wxyz)


def encode_depth_image(timestamp_ns: int, frame: str, image: DepthImage) -> bytes:
    """Return a sensor_msgs/Image of depth (REP 118).

    An image in millimeters is passed on as 16UC1, where 0 means no return. An image of another scale becomes 32FC1 in
    meters, where NaN means no return.
    """
    if image.scale_m == MILLIMETER_M:
        encoding = "16UC1"
        pixels = image.depth
    else:
        encoding = "32FC1"
        counts = np.frombuffer(image.depth, dtype="<u2")
        depth_m = np.where(counts == 0, np.nan, counts * image.scale_m)
        pixels = depth_m.astype("<f4").tobytes()
    return ros.encode_image(timestamp_ns, frame, image.width, image.height, encoding, pixels)


def encode_color_image(timestamp_ns: int, frame: str, image: ColorImage) -> bytes:
    """Return a sensor_msgs/Image in rgb8."""
    return ros.encode_image(timestamp_ns, frame, image.width, image.height, "rgb8", image.rgb)


def encode_compressed_depth(timestamp_ns: int, frame: str, image: DepthImage) -> bytes:
    """Return a sensor_msgs/CompressedImage with a 16 bit PNG in millimeters, where 0 means no return.

    In front of the PNG are 12 bytes of parameters, which the reader skips for integer images.
    """
    depth_mm = np.frombuffer(image.depth, dtype="<u2") * (image.scale_m / MILLIMETER_M)
    counts = np.where(depth_mm > MAX_DEPTH_COUNTS, 0, np.rint(depth_mm)).astype(">u2")
    picture = encode_png(image.width, image.height, counts.tobytes(), bits=16, color=False)
    data = INVERSE_DEPTH_UNUSED + picture
    return ros.encode_compressed_image(timestamp_ns, frame, "16UC1; compressedDepth png", data)


def encode_compressed_color(timestamp_ns: int, frame: str, image: ColorImage) -> bytes:
    """Return a sensor_msgs/CompressedImage with a lossless 8 bit PNG. OpenCV reads it as bgr8, as its format states."""
    picture = encode_png(image.width, image.height, image.rgb, bits=8, color=True)
    return ros.encode_compressed_image(timestamp_ns, frame, "rgb8; png compressed bgr8", picture)


def encode_imu(timestamp_ns: int, frame: str, imus: Imu, imu_index: int) -> bytes:
    """Encode the IMU of one link as a sensor_msgs/Imu in CDR; its acceleration is the specific force (REP 145).

    Args:
        timestamp_ns: Time of the sample.
        frame: Frame of the IMU.
        imus: Measurements of all IMUs of the robot.
        imu_index: Index of this IMU within the measurements.
    """
    unknown_covariance = np.zeros(9)
    # A covariance of -1: this IMU measures no orientation.
    no_orientation = np.array([-1.0, *[0.0] * 8])
    return ros.encode_message(
        ros.IMU,
        ros.make_header(timestamp_ns, frame),
        ros.make_quaternion((1.0, 0.0, 0.0, 0.0)),
        no_orientation,
        ros.make_vector(imus.angular_velocity_rad_s[imu_index]),
        unknown_covariance,
        ros.make_vector(imus.acceleration_m_s2[imu_index]),
        unknown_covariance,
    )


def encode_camera_info(timestamp_ns: int, frame: str, image: DepthImage | ColorImage) -> bytes:
    """Encode the intrinsics of a camera without distortion as a sensor_msgs/CameraInfo.

    Args:
        timestamp_ns: Time of the image in ROS.
        frame: Optical frame of the camera.
        image: The depth or color image, which carries the intrinsics.
    """
    intrinsics = np.array(
        [
            [image.fx_px, 0.0, image.cx_px],
            [0.0, image.fy_px, image.cy_px],
            [0.0, 0.0, 1.0],
        ]
    )
    projection = np.hstack([intrinsics, np.zeros((3, 1))])
    no_binning = 0
    whole_image = ros.make_message("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    return ros.encode_message(
        ros.CAMERA_INFO,
        ros.make_header(timestamp_ns, frame),
        image.height,
        image.width,
        PLUMB_BOB,
        np.zeros(5),  # D: distortion
        intrinsics.ravel(),  # K
        np.eye(3).ravel(),  # R: rectification
        projection.ravel(),  # P
        no_binning,
        no_binning,
        whole_image,
    )


def encode_laser_scan(timestamp_ns: int, frame: str, scan: RangeScan) -> bytes:
    """Return a sensor_msgs/LaserScan with all beams at one time. Beams without a return are infinite (REP 117)."""
    ranges_m = [np.inf if range_m is None else range_m for range_m in scan.range_m]
    angle_max_rad = scan.angle_min_rad + scan.angle_step_rad * (len(ranges_m) - 1)
    return ros.encode_message(
        ros.LASER_SCAN,
        ros.make_header(timestamp_ns, frame),
        scan.angle_min_rad,
        angle_max_rad,
        scan.angle_step_rad,
        0.0,  # time from beam to beam
        0.0,  # time from scan to scan: not stated
        scan.range_min_m,
        scan.range_max_m,
        np.array(ranges_m, dtype=np.float32),
        np.array([], dtype=np.float32),  # intensities
    )


def encode_numbers(
    kind: CustomMessage, field: str, _timestamp_ns: int, _frame: str, sample: CustomSample
) -> bytes:
    """Return a std_msgs/Float64MultiArray with one field of a custom sensor's sample.

    The array has one dimension, labeled with the field's name and unit. This type has neither timestamp nor frame.
    """
    values: list[float] = []
    for name, value in kind.extract_numeric_values(sample).items():
        field_name, _, _ = name.partition(".")
        if field_name == field:
            values.append(value)
    label = f"{field} [{kind.units[field]}]"
    size = len(values)
    stride = len(values)
    dimension = ros.make_message("std_msgs/msg/MultiArrayDimension", label, size, stride)
    layout = ros.make_message("std_msgs/msg/MultiArrayLayout", [dimension], 0)
    return ros.encode_message(ros.FLOAT64_ARRAY, layout, np.array(values, dtype=np.float64))


def encode_diagnostics(timestamp_ns: int, status: RobotStatus) -> bytes:
    """Encode the robot's status as a diagnostic_msgs/DiagnosticArray with one entry: state, reason and faults.

    Args:
        timestamp_ns: Time of the status in ROS.
        status: The newest status.
    """
    values = {
        "lifecycle": status.lifecycle,
        "backend": status.backend,
        "lease holder": status.lease_holder or "free",
        "rate_hz": f"{status.rate_hz:g}",
        "overruns": str(status.overruns),
        "isolated joints": ", ".join(status.isolated) or "none",
    }
    for i, fault in enumerate(status.faults):
        values[f"fault {i}"] = f"{fault.what}: {fault.cause}"
    pairs = [
        ros.make_message("diagnostic_msgs/msg/KeyValue", key, value)
        for key, value in values.items()
    ]
    level = _find_diagnostic_level(status)
    summary = f"{status.lifecycle}: {status.reason}"
    hardware_id = status.robot
    entry = ros.make_message(
        "diagnostic_msgs/msg/DiagnosticStatus", level, status.robot, summary, hardware_id, pairs
    )
    return ros.encode_message(ros.DIAGNOSTICS, ros.make_header(timestamp_ns, ""), [entry])


def _find_diagnostic_level(status: RobotStatus) -> int:
    if status.lifecycle in ("fault", "estop"):
        return ERROR
    if status.faults or status.isolated or status.derated:
        return WARN
    return OK
