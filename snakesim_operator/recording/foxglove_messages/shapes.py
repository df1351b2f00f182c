"""Makes Foxglove's messages from the robot's: transforms, shapes, arrows, paths and images.

Source: https://docs.foxglove.dev/docs/sdk/schemas. There, a cylinder's axis is z, an arrow points along x, and a
camera looks along z with x to the right.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from snakesim_hal.wire.messages import (
    ColorImage,
    DepthImage,
    KnownObstacle,
    LinkDescription,
    RobotDescription,
    WorldContact,
)

WORLD_FRAME = "world"

# How things are drawn.
BODY_COLOR = Color(r=0.18, g=0.49, b=0.60, a=1.0)
TRUE_OBSTACLE_COLOR = Color(r=0.55, g=0.55, b=0.58, a=1.0)
MAP_COLOR = Color(r=0.95, g=0.60, b=0.10, a=0.45)  # transparent: it covers the true obstacles
FORCE_COLOR = Color(r=0.85, g=0.15, b=0.20, a=1.0)
PATH_COLOR = Color(r=0.20, g=0.65, b=0.30, a=1.0)
ARROW_LENGTH_M_PER_N = 0.01
MAX_ARROW_LENGTH_M = 0.5
ARROW_SHAFT_DIAMETER_M = 0.012
ARROW_HEAD_DIAMETER_M = 0.03
PATH_WIDTH_M = 0.01
PATH_HEIGHT_M = 0.005  # above the ground, else the ground hides parts of it

MAX_DEPTH_MM = 65535  # 16 bits

_UPRIGHT = Quaternion(w=1.0)
# Lays a cylinder along the link.
_ROTATION_FROM_Z_TO_X = Quaternion(w=math.sqrt(0.5), y=math.sqrt(0.5))
_OPTICAL_IN_CAMERA = (0.5, -0.5, 0.5, -0.5)  # wxyz: Foxglove's camera frame in the robot's


def make_timestamp(time_ns: int) -> Timestamp:
    """Return a robot time in ns as a protobuf timestamp."""
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)


def make_frame_transform(
    time_ns: int,
    parent: str,
    child: str,
    position: Sequence[float],
    orientation_wxyz: Sequence[float],
) -> FrameTransform:
    """Return a FrameTransform with the pose of a child frame in its parent frame.

    Args:
        time_ns: Robot time.
        parent: Name of the parent frame.
        child: Name of the child frame.
        position: (3,) position of the child frame in the parent frame, m.
        orientation_wxyz: (4,) orientation of the child frame in the parent frame.
    """
    w, x, y, z = orientation_wxyz
    return FrameTransform(
        timestamp=make_timestamp(time_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=position[0], y=position[1], z=position[2]),
        rotation=Quaternion(w=w, x=x, y=y, z=z),
    )


def compute_optical_orientation(camera_wxyz: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the orientation of Foxglove's optical frame for a camera of the robot, as a quaternion wxyz.

    It is the quaternion product p q of the camera's orientation p and the orientation q of the optical frame in the
    camera's frame.

    Args:
        camera_wxyz: (4,) orientation of the camera.
    """
    pw, px, py, pz = camera_wxyz
    qw, qx, qy, qz = _OPTICAL_IN_CAMERA
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def draw_body(robot: RobotDescription, time_ns: int) -> list[SceneEntity]:
    """Return one scene entity for each link: a capsule in the frame of the link."""
    return [_draw_link(link, time_ns) for link in robot.links]


def _draw_link(link: LinkDescription, time_ns: int) -> SceneEntity:
    middle = Pose(position=Vector3(x=0.5 * link.length_m), orientation=_ROTATION_FROM_Z_TO_X)
    diameter_m = 2 * link.radius_m
    return SceneEntity(
        timestamp=make_timestamp(time_ns),
        frame_id=link.name,
        id=link.name,
        frame_locked=True,
        cylinders=[_make_cylinder(middle, link.radius_m, link.length_m, BODY_COLOR)],
        spheres=[
            _make_sphere(0.0, 0.0, 0.0, diameter_m, BODY_COLOR),
            _make_sphere(link.length_m, 0.0, 0.0, diameter_m, BODY_COLOR),
        ],
    )


def draw_obstacles(
    obstacles: Iterable[KnownObstacle], name: str, color: Color, time_ns: int
) -> SceneEntity:
    """Return obstacles as one entity of a Foxglove scene, in the world frame.

    Args:
        obstacles: Spheres, boxes and cylinders.
        name: Identifier of the entity; a viewer replaces an earlier entity of the same name.
        color: Color of all obstacles.
        time_ns: Robot time.
    """
    entity = SceneEntity(timestamp=make_timestamp(time_ns), frame_id=WORLD_FRAME, id=name)
    for obstacle in obstacles:
        x, y, z = obstacle.position_w
        half_yaw_rad = 0.5 * obstacle.yaw_rad
        orientation = Quaternion(w=math.cos(half_yaw_rad), z=math.sin(half_yaw_rad))
        pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=orientation)
        match obstacle.shape:
            case "sphere":
                diameter_m = 2 * obstacle.radius_m
                entity.spheres.append(_make_sphere(x, y, z, diameter_m, color))
            case "box":
                half_x_m, half_y_m, half_z_m = obstacle.half_size_m
                size = Vector3(x=2 * half_x_m, y=2 * half_y_m, z=2 * half_z_m)
                entity.cubes.append(CubePrimitive(pose=pose, size=size, color=color))
            case "cylinder":
                entity.cylinders.append(
                    _make_cylinder(pose, obstacle.radius_m, obstacle.height_m, color)
                )
    return entity


def draw_forces(contacts: Iterable[WorldContact], time_ns: int) -> SceneEntity:
    """Return contact forces on the body as one entity of a Foxglove scene: an arrow at each contact.

    Args:
        contacts: Contacts in the world frame. The length of an arrow is proportional to the force, and at most
            MAX_ARROW_LENGTH_M. A contact without force has no arrow.
        time_ns: Robot time.
    """
    entity = SceneEntity(timestamp=make_timestamp(time_ns), frame_id=WORLD_FRAME, id="forces")
    for contact in contacts:
        force_n = math.hypot(*contact.force_w)
        if force_n <= 0.0:
            continue
        length_m = min(ARROW_LENGTH_M_PER_N * force_n, MAX_ARROW_LENGTH_M)
        x, y, z = contact.position_w
        orientation = _compute_rotation_from_x_axis(contact.force_w, force_n)
        arrow = ArrowPrimitive(
            pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=orientation),
            shaft_length=0.8 * length_m,
            shaft_diameter=ARROW_SHAFT_DIAMETER_M,
            head_length=0.2 * length_m,
            head_diameter=ARROW_HEAD_DIAMETER_M,
            color=FORCE_COLOR,
        )
        entity.arrows.append(arrow)
    return entity


def draw_path(points_w: Iterable[Sequence[float]], time_ns: int) -> SceneEntity:
    """Return a planned path as a scene entity with a line on the ground.

    Args:
        points_w: Points of the path in the world frame; only x and y are used, m.
        time_ns: Robot time.
    """
    line = LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=Pose(orientation=_UPRIGHT),
        thickness=PATH_WIDTH_M,
        color=PATH_COLOR,
        points=[Point3(x=point[0], y=point[1], z=PATH_HEIGHT_M) for point in points_w],
    )
    return SceneEntity(
        timestamp=make_timestamp(time_ns), frame_id=WORLD_FRAME, id="path", lines=[line]
    )


def make_raw_image(image: DepthImage | ColorImage, frame_id: str, time_ns: int) -> RawImage:
    """Return a camera image as a Foxglove message: color as rgb8, depth as 16UC1 in millimeters.

    Args:
        image: The image as the robot publishes it.
        frame_id: Name of the optical frame of the camera.
        time_ns: Robot time of the image.
    """
    if isinstance(image, ColorImage):
        data = image.rgb
        encoding = "rgb8"
        pixel_bytes = 3
    else:
        data = _convert_to_millimeters(image)
        encoding = "16UC1"
        pixel_bytes = 2
    return RawImage(
        timestamp=make_timestamp(time_ns),
        frame_id=frame_id,
        width=image.width,
        height=image.height,
        encoding=encoding,
        step=pixel_bytes * image.width,  # bytes per row
        data=data,
    )


def _convert_to_millimeters(image: DepthImage) -> bytes:
    """Return the pixels of a depth image as unsigned 16 bit numbers in mm, little endian."""
    counts = np.frombuffer(image.depth, dtype="<u2")
    if image.scale_m == 0.001:
        return counts.tobytes()
    depth_mm = np.minimum(counts * (image.scale_m * 1000), MAX_DEPTH_MM)
    return depth_mm.astype("<u2").tobytes()


def make_calibration(
    image: DepthImage | ColorImage, frame_id: str, time_ns: int
) -> CameraCalibration:
    """Return the pinhole model of an image's camera: intrinsics K, no rectification R, projection P."""
    fx = image.fx_px
    fy = image.fy_px
    cx = image.cx_px
    cy = image.cy_px
    return CameraCalibration(
        timestamp=make_timestamp(time_ns),
        frame_id=frame_id,
        width=image.width,
        height=image.height,
        K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    )


def _make_cylinder(pose: Pose, radius_m: float, length_m: float, color: Color) -> CylinderPrimitive:
    size = Vector3(x=2 * radius_m, y=2 * radius_m, z=length_m)
    return CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=color)


def _make_sphere(x: float, y: float, z: float, diameter_m: float, color: Color) -> SpherePrimitive:
    size = Vector3(x=diameter_m, y=diameter_m, z=diameter_m)
    pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=_UPRIGHT)
    return SpherePrimitive(pose=pose, size=size, color=color)


def _compute_rotation_from_x_axis(vector: Sequence[float], length: float) -> Quaternion:
    """Return the shortest rotation that turns the x axis into the direction of a vector.

    Args:
        vector: (3,) vector.
        length: Length of the vector, above 0.
    """
    x, y, z = (value / length for value in vector)
    if x < -0.999999:
        return Quaternion(z=1.0)  # half a turn about z; the formula below would divide by 0
    w = math.sqrt(0.5 * (1.0 + x))
    return Quaternion(w=w, y=-z / (2 * w), z=y / (2 * w))
