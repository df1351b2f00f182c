"""The console draws links, forces, obstacles and cameras where the robot's kinematics place them."""

import math

import msgspec
import numpy as np
import pytest

from snakesim_hal.model.geometry.kinematics import (
    quaternion_from_yaw,
    quaternions_from_rotations,
    rotation_from_quaternion,
)
from snakesim_hal.wire.messages import DepthImage, KnownObstacle
from snakesim_operator.features.console.page.force_polygon import (
    draw_force_polygon,
    format_push_point_table,
)
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import M_PER_N, MAX_FORCE_ARROW_M, draw
from snakesim_testing.operator.drawn_samples import (
    JOINT_COUNT,
    ROBOT,
    make_contact,
    make_control_state,
    make_joints,
    make_world_model,
)


def test_drawing_links_and_hinges_follow_base_pose_and_joint_angles():
    """The base heads along y, and the first joint turns right, so that the second link heads along x."""
    quarter_turn_rad = math.pi / 2
    base_x, base_y, base_z = 1.0, 2.0, 0.1
    base = (base_x, base_y, base_z), quaternion_from_yaw(quarter_turn_rad)
    drawing = draw(RobotSnapshot(robot=ROBOT, body=make_joints(-quarter_turn_rad), base=base), None)
    assert drawing is not None
    first_m = ROBOT.links[0].length_m
    second_m = ROBOT.links[1].length_m
    hinge_y = base_y + first_m
    assert drawing.links_w[0] == pytest.approx([base_x, base_y + first_m / 2, base_z])
    assert drawing.hinges_w[0] == pytest.approx([base_x, hinge_y, base_z])
    assert drawing.links_w[1] == pytest.approx([base_x + second_m / 2, hinge_y, base_z])
    assert rotation_from_quaternion(drawing.links_wxyz[1])[:, 0] == pytest.approx([1.0, 0.0, 0.0])
    axis = [0.0, 0.0, 1.0] if ROBOT.joints[0].axis == "yaw" else [0.0, 1.0, 0.0]
    assert rotation_from_quaternion(drawing.hinges_wxyz[0])[:, 2] == pytest.approx(axis, abs=1e-9)


def test_drawing_without_joints_is_none():
    assert draw(RobotSnapshot(robot=ROBOT), None) is None


def test_drawing_has_forces_and_their_resultant():
    point = make_contact((0.0, 10.0, 0.0))
    control = make_control_state([point], [20.0], propulsion_joint=ROBOT.joints[-1].name)
    world = make_world_model([point, point], [])
    drawing = draw(
        RobotSnapshot(robot=ROBOT, body=make_joints(), world=world, control=control), None
    )
    assert drawing is not None
    assert drawing.propulsion_joint == JOINT_COUNT - 1
    assert drawing.pushed_obstacles == {"peg"}
    measured, resultant, desired = (
        arrows[:, 1] - arrows[:, 0]
        for arrows in (drawing.measured_forces, drawing.resultant, drawing.desired_forces)
    )
    assert [len(measured), len(resultant), len(desired)] == [2, 1, 1]
    assert measured[0] == pytest.approx([0.0, 10 * M_PER_N, 0.0])
    assert resultant[0] == pytest.approx([0.0, 20 * M_PER_N, 0.0])
    assert desired[0] == pytest.approx([0.0, 20 * M_PER_N, 0.0])


def test_drawing_requested_force_without_contact_is_no_contact_force():
    points = [
        make_contact((0.0, 10.0, 0.0), "touched", x_m=0.1),
        make_contact((0.0, 10.0, 0.0), "distant", x_m=0.3),
    ]
    control = make_control_state(points, [20.0, 30.0], measured_force_n=[17.5, 0.0])
    snapshot = RobotSnapshot(
        robot=ROBOT, body=make_joints(), world=make_world_model(points[:1], []), control=control
    )
    drawing = draw(snapshot, None)
    assert drawing is not None
    assert drawing.pushed_obstacles == {"touched"}
    assert drawing.desired_forces[:, 0, 0] == pytest.approx([0.1])
    assert drawing.forces_without_contact[:, 0, 0] == pytest.approx([0.3])
    start, end = drawing.forces_without_contact[0]
    assert end - start == pytest.approx([0.0, MAX_FORCE_ARROW_M, 0.0])
    table = format_push_point_table(control)
    assert "<td>touched</td><td>20.0</td><td>17.5</td>" in table
    assert "<td>distant</td><td>30.0</td><td>0.0</td>" in table
    assert format_push_point_table(msgspec.structs.replace(control, measured_force_n=[])) == ""


def test_drawing_strong_force_has_arrow_of_limited_length():
    point = make_contact((0.0, 500.0, 0.0))
    drawing = draw(
        RobotSnapshot(robot=ROBOT, body=make_joints(), world=make_world_model([point], [])), None
    )
    assert drawing is not None
    start, end = drawing.measured_forces[0]
    assert end - start == pytest.approx([0.0, MAX_FORCE_ARROW_M, 0.0])
    assert start[2] > ROBOT.links[0].radius_m
    assert drawing.contacts_w[0] == pytest.approx(point.position_w)


def test_force_polygon_names_every_force_and_the_resultant():
    head_contact = make_contact((0.0, 4.0, 0.0), "<b>", body_s_m=0.3)
    tail_contact = make_contact((3.0, 0.0, 0.0), "<b>", body_s_m=0.1)
    polygon = draw_force_polygon(
        RobotSnapshot(robot=ROBOT, world=make_world_model([head_contact, tail_contact], []))
    )
    assert "resultant 5.0 N" in polygon
    assert polygon.index(">3.0 N<") < polygon.index(">4.0 N<") < polygon.index(">5.0 N<")
    assert "no contact force" in draw_force_polygon(
        RobotSnapshot(robot=ROBOT, world=make_world_model([], []))
    )


def test_drawing_mapped_obstacle_is_not_drawn_as_perceived():
    mapped = KnownObstacle(name="a", shape="sphere", position_w=(0.0, 0.0, 0.0))
    seen = KnownObstacle(name="b", shape="sphere", position_w=(0.0, 0.0, 0.0), last_seen_ns=1)
    touched = KnownObstacle(name="c", shape="sphere", position_w=(0.0, 0.0, 0.0), touched=True)
    drawing = draw(
        RobotSnapshot(
            robot=ROBOT, body=make_joints(), world=make_world_model([], [mapped, seen, touched])
        ),
        None,
    )
    assert drawing is not None
    assert [obstacle.name for obstacle in drawing.perceived] == ["b", "c"]


def test_drawing_camera_along_its_link_looks_along_x():
    image = DepthImage(
        tick=1,
        timestamp_ns=1,
        link=0,
        position_l=(0.0, 0.0, 0.0),
        orientation_l_wxyz=(1.0, 0.0, 0.0, 0.0),
        width=4,
        height=2,
        fx_px=1.0,
        fy_px=1.0,
        cx_px=2.0,
        cy_px=1.0,
        range_min_m=0.1,
        range_max_m=1.0,
        scale_m=0.001,
        depth=bytes(16),
    )
    drawing = draw(
        RobotSnapshot(robot=ROBOT, body=make_joints(), images={"sensor/depth/head": image}), None
    )
    assert drawing is not None
    camera_rotation = rotation_from_quaternion(drawing.cameras[0].wxyz)
    assert camera_rotation[:, 2] == pytest.approx([1.0, 0.0, 0.0])
    assert camera_rotation[:, 1] == pytest.approx([0.0, 0.0, -1.0])
    assert drawing.cameras[0].fov_rad == pytest.approx(math.pi / 2)
    assert drawing.cameras[0].aspect == 2.0


def test_quaternions_from_rotations_reproduce_the_rotations():
    rng = np.random.default_rng(1)
    wxyz = np.vstack([np.eye(4), rng.normal(size=(50, 4))])
    rotations = np.array([rotation_from_quaternion(q) for q in wxyz])
    quaternions = quaternions_from_rotations(rotations)
    reproduced = np.array([rotation_from_quaternion(q) for q in quaternions])
    assert reproduced == pytest.approx(rotations, abs=1e-12)
