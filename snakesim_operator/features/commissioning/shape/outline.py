"""The outlines of a robot's links in a drawn shape, in true scale. Pure.

The drawing is seen from above, with the head to the right. For joints that yaw, the robot lies on its belly. For joints
that pitch, it lies on its left side, so that its top points up the page.
"""

import hashlib
import math
from collections.abc import Sequence

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.commissioning.shape.design import ShapePose
from snakesim_operator.features.commissioning.shape.drawing import GRAY, Drawing, Label, Stroke

MM_PER_M = 1000.0
JOINT_MARK_MM = 2.5  # radius of the circle around a joint's axis
ARROW_MM = 8.0
ARC_POINTS = 13  # of a half circle
LABEL_GAP_MM = 3.0  # between outline and text


def compute_drawing_mark(robot: RobotFile, poses: Sequence[ShapePose]) -> str:
    """Return six characters that are on every sheet. They change if sizes or angles of the drawing change."""
    angles = [(pose.name, pose.axis, np.round(pose.angle_rad, 6).tolist()) for pose in poses]
    content = msgspec.json.encode((angles, robot.link_lengths_m, robot.module.radius_m))
    return hashlib.sha256(content).hexdigest()[:6]


def compute_joint_positions_mm(robot: RobotFile, pose: ShapePose, turn_rad: float = 0.0) -> Floats:
    """Return tail, joints and head of a robot in a shape, (n_joints + 2, 2).

    Args:
        robot: The robot.
        pose: The shape.
        turn_rad: Direction of the tail link, counterclockwise from the x axis.
    """
    directions_rad = turn_rad + _compute_link_directions_rad(pose)
    steps_mm = (
        MM_PER_M * np.array(robot.link_lengths_m)[:, None] * _make_unit_vectors(directions_rad)
    )
    return np.concatenate((np.zeros((1, 2)), np.cumsum(steps_mm, axis=0)))


def draw_shape(robot: RobotFile, pose: ShapePose, turn_rad: float = 0.0) -> Drawing:
    """Draw the outlines of all links, the axes of the joints, and their names and angles.

    Args:
        robot: The robot, with its lengths.
        pose: The shape.
        turn_rad: Direction of the tail link, counterclockwise from the x axis.
    """
    positions_mm = compute_joint_positions_mm(robot, pose, turn_rad)
    directions_rad = turn_rad + _compute_link_directions_rad(pose)
    half_width_mm = MM_PER_M * robot.module.radius_m
    strokes: list[Stroke] = []
    labels: list[Label] = []
    for link, direction_rad in enumerate(directions_rad):
        is_head = link == len(directions_rad) - 1
        outline_mm = _make_link_outline_mm(
            positions_mm[link],
            positions_mm[link + 1],
            direction_rad,
            half_width_mm,
            round_front=is_head,
        )
        strokes.append(Stroke(outline_mm, width_mm=0.5, closed=True))
    strokes.append(Stroke(positions_mm, width_mm=0.25, gray=GRAY, dashed=True))
    for joint, name in enumerate(joint.name for joint in robot.joint_table):
        center_mm = positions_mm[joint + 1]
        strokes += _draw_joint_mark(center_mm)
        middle_rad = (directions_rad[joint] + directions_rad[joint + 1]) / 2
        labels.append(
            _label_joint(name, pose.angle_rad[joint], center_mm, middle_rad, half_width_mm)
        )
    strokes.append(_draw_head_arrow(positions_mm[-1], directions_rad[-1], half_width_mm))
    return Drawing(strokes, labels)


def _compute_link_directions_rad(pose: ShapePose) -> Floats:
    """Return the direction of each link relative to the tail link, counterclockwise on the page, (n_joints + 1,)."""
    counterclockwise = -1.0 if pose.axis == "pitch" else 1.0  # pitch is positive downwards
    return np.concatenate(([0.0], np.cumsum(counterclockwise * pose.angle_rad)))


def _make_unit_vectors(direction_rad: Floats) -> Floats:
    return np.stack((np.cos(direction_rad), np.sin(direction_rad)), axis=-1)


def _make_link_outline_mm(
    rear_mm: Floats,
    front_mm: Floats,
    direction_rad: float,
    half_width_mm: float,
    *,
    round_front: bool,
) -> Floats:
    """Return the outline of a link from above: a rectangle, with half a circle at the front of the head."""
    forward = _make_unit_vectors(np.array(direction_rad))
    side_mm = half_width_mm * np.array((-forward[1], forward[0]))
    if not round_front:
        return np.array(
            (rear_mm + side_mm, rear_mm - side_mm, front_mm - side_mm, front_mm + side_mm)
        )
    arc_rad = direction_rad + np.linspace(-math.pi / 2, math.pi / 2, ARC_POINTS)
    cap_mm = front_mm + half_width_mm * _make_unit_vectors(arc_rad)
    return np.concatenate(((rear_mm + side_mm, rear_mm - side_mm), cap_mm))


def _draw_joint_mark(center_mm: Floats) -> list[Stroke]:
    """Draw a circle with a cross around the axis of a joint."""
    circle_mm = center_mm + JOINT_MARK_MM * _make_unit_vectors(
        np.linspace(0.0, math.tau, 24, endpoint=False)
    )
    across_mm = np.array(((-JOINT_MARK_MM, 0.0), (JOINT_MARK_MM, 0.0)))
    upright_mm = across_mm[:, ::-1]
    return [
        Stroke(circle_mm, width_mm=0.2, closed=True),
        Stroke(center_mm + across_mm, width_mm=0.2),
        Stroke(center_mm + upright_mm, width_mm=0.2),
    ]


def _label_joint(
    name: str, angle_rad: float, center_mm: Floats, direction_rad: float, half_width_mm: float
) -> Label:
    """Write name and angle of a joint beside the body, above it where the body is level."""
    left = _make_unit_vectors(np.array(direction_rad + math.pi / 2))
    upward = left if left[1] >= 0 else -left
    x_mm, y_mm = (center_mm + (1.25 * half_width_mm + LABEL_GAP_MM) * upward).tolist()
    return Label(f"{name} {math.degrees(angle_rad):+.0f}°", (x_mm, y_mm), centered=True)


def _draw_head_arrow(head_mm: Floats, direction_rad: float, half_width_mm: float) -> Stroke:
    """Draw a triangle ahead of the head, which points forwards."""
    forward = _make_unit_vectors(np.array(direction_rad))
    side = np.array((-forward[1], forward[0]))
    base_mm = head_mm + (half_width_mm + LABEL_GAP_MM) * forward
    corners_mm = (
        base_mm + ARROW_MM / 2 * side,
        base_mm - ARROW_MM / 2 * side,
        base_mm + ARROW_MM * forward,
    )
    return Stroke(np.array(corners_mm), width_mm=0.5, closed=True)
