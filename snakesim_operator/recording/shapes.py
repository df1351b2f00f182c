"""Foxglove's messages, made of ours: transforms, joint states, shapes, arrows, images. Pure.

Source: https://docs.foxglove.dev/docs/sdk/schemas. A cylinder's axis is z there, an arrow points along x,
a camera looks along z with x to the right.
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

from snakesim_hal.wire.messages import ColorImage, DepthImage, Description, Obstacle, WorldContact

WORLD_FRAME = "world"
FORCE_M_PER_N = 0.01
LONGEST_ARROW_M = 0.5
SNAKE, TRUTH, MAP, FORCE, PATH = (
    Color(r=0.18, g=0.49, b=0.60, a=1.0),
    Color(r=0.55, g=0.55, b=0.58, a=1.0),
    Color(r=0.95, g=0.60, b=0.10, a=0.45),
    Color(r=0.85, g=0.15, b=0.20, a=1.0),
    Color(r=0.20, g=0.65, b=0.30, a=1.0),
)
_UPRIGHT = Quaternion(w=1.0)
_ALONG_X = Quaternion(w=math.sqrt(0.5), y=math.sqrt(0.5))  # z of a cylinder along the link
_OPTICAL = (0.5, -0.5, 0.5, -0.5)  # wxyz: Foxglove's camera frame in ours


def stamp(time_ns: int) -> Timestamp:
    """Robot time."""
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)


def frame(time_ns: int, parent: str, child: str, position: Sequence[float], wxyz: Sequence[float]) -> FrameTransform:
    """Where a frame is in another."""
    w, x, y, z = wxyz
    return FrameTransform(
        timestamp=stamp(time_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=position[0], y=position[1], z=position[2]),
        rotation=Quaternion(w=w, x=x, y=y, z=z),
    )


def optical(wxyz: Sequence[float]) -> tuple[float, float, float, float]:
    """The orientation of Foxglove's camera frame, of ours."""
    (a, b, c, d), (e, f, g, h) = wxyz, _OPTICAL
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def body(robot: Description, time_ns: int) -> list[SceneEntity]:
    """The links, each in its own frame."""
    return [
        SceneEntity(
            timestamp=stamp(time_ns),
            frame_id=link.name,
            id=link.name,
            frame_locked=True,
            cylinders=[
                _cylinder(
                    Pose(position=Vector3(x=0.5 * link.length_m), orientation=_ALONG_X),
                    link.radius_m,
                    link.length_m,
                    SNAKE,
                )
            ],
            spheres=[
                _ball(0.0, 0.0, 0.0, 2 * link.radius_m, SNAKE),
                _ball(link.length_m, 0.0, 0.0, 2 * link.radius_m, SNAKE),
            ],
        )
        for link in robot.links
    ]


def obstacles(found: Iterable[Obstacle], name: str, color: Color, time_ns: int) -> SceneEntity:
    """Obstacles in the world."""
    entity = SceneEntity(timestamp=stamp(time_ns), frame_id=WORLD_FRAME, id=name)
    for one in found:
        x, y, z = one.position_w
        if one.shape == "sphere":
            entity.spheres.append(_ball(x, y, z, 2 * one.radius_m, color))
            continue
        half_yaw = 0.5 * one.yaw_rad
        turned = Quaternion(w=math.cos(half_yaw), z=math.sin(half_yaw))
        pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=turned)
        if one.shape == "box":
            size = Vector3(**{axis: 2 * half for axis, half in zip("xyz", one.half_size_m, strict=True)})
            entity.cubes.append(CubePrimitive(pose=pose, size=size, color=color))
        else:
            entity.cylinders.append(_cylinder(pose, one.radius_m, one.height_m, color))
    return entity


def forces(contacts: Iterable[WorldContact], time_ns: int) -> SceneEntity:
    """An arrow for the force on the body at each contact, one centimetre a newton."""
    entity = SceneEntity(timestamp=stamp(time_ns), frame_id=WORLD_FRAME, id="forces")
    for contact in contacts:
        size_n = math.hypot(*contact.force_w)
        if size_n <= 0.0:
            continue
        length_m = min(FORCE_M_PER_N * size_n, LONGEST_ARROW_M)
        x, y, z = contact.position_w
        entity.arrows.append(
            ArrowPrimitive(
                pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=_towards(contact.force_w, size_n)),
                shaft_length=0.8 * length_m,
                shaft_diameter=0.012,
                head_length=0.2 * length_m,
                head_diameter=0.03,
                color=FORCE,
            )
        )
    return entity


def path(points_w: Iterable[Sequence[float]], time_ns: int) -> SceneEntity:
    """A planned path on the ground."""
    line = LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=Pose(orientation=_UPRIGHT),
        thickness=0.01,
        color=PATH,
        points=[Point3(x=point[0], y=point[1], z=0.005) for point in points_w],
    )
    return SceneEntity(timestamp=stamp(time_ns), frame_id=WORLD_FRAME, id="path", lines=[line])


def raw_image(image: DepthImage | ColorImage, frame_id: str, time_ns: int) -> RawImage:
    """Depth in millimetres (16UC1), or color (rgb8)."""
    if isinstance(image, ColorImage):
        data, encoding, pixel_bytes = image.rgb, "rgb8", 3
    else:
        counts = np.frombuffer(image.depth, dtype="<u2")
        in_mm = counts if image.scale_m == 0.001 else np.minimum(counts * (image.scale_m * 1000), 65535)
        data, encoding, pixel_bytes = in_mm.astype("<u2").tobytes(), "16UC1", 2
    return RawImage(
        timestamp=stamp(time_ns),
        frame_id=frame_id,
        width=image.width,
        height=image.height,
        encoding=encoding,
        step=pixel_bytes * image.width,
        data=data,
    )


def calibration(image: DepthImage | ColorImage, frame_id: str, time_ns: int) -> CameraCalibration:
    """The pinhole of an image."""
    fx, fy, cx, cy = image.fx_px, image.fy_px, image.cx_px, image.cy_px
    return CameraCalibration(
        timestamp=stamp(time_ns),
        frame_id=frame_id,
        width=image.width,
        height=image.height,
        K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    )


def _cylinder(pose: Pose, radius_m: float, length_m: float, color: Color) -> CylinderPrimitive:
    size = Vector3(x=2 * radius_m, y=2 * radius_m, z=length_m)
    return CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=color)


def _ball(x: float, y: float, z: float, diameter_m: float, color: Color) -> SpherePrimitive:
    size = Vector3(x=diameter_m, y=diameter_m, z=diameter_m)
    return SpherePrimitive(pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=_UPRIGHT), size=size, color=color)


def _towards(vector: Sequence[float], length: float) -> Quaternion:
    """The shortest turn from x to a vector."""
    x, y, z = (value / length for value in vector)
    if x < -0.999999:
        return Quaternion(z=1.0)
    w = math.sqrt(0.5 * (1.0 + x))
    return Quaternion(w=w, y=-z / (2 * w), z=y / (2 * w))
