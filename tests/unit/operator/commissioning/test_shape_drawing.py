"""Drawn shapes: their angles distinguish all joints, and their sheets are in true scale."""

import itertools
import re
import zlib

import numpy as np
import pytest

from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.commissioning.shape.design import (
    MAX_SHAPE_ANGLE_RAD,
    PLACEMENT_TOLERANCE_RAD,
    choose_codes,
    compute_separations,
    design_poses,
)
from snakesim_operator.features.commissioning.shape.drawing import (
    POINTS_PER_MM,
    encode_pdf,
    encode_svg,
)
from snakesim_operator.features.commissioning.shape.outline import (
    compute_drawing_mark,
    compute_joint_positions_mm,
    draw_shape,
)
from snakesim_operator.features.commissioning.shape.pages import make_pages, make_poster, tile_shape


def read_robot(name: str) -> RobotFile:
    """Read a robot file that is shipped."""
    return decode_table(read_table_with_base(name, "robots"), RobotFile)


@pytest.mark.parametrize("count", [1, 2, 5, 13, 18, 19, 40])
def test_shape_codes_have_both_signs_and_exceed_tolerance(count: int) -> None:
    codes = choose_codes(count)
    assert len(codes) == count
    assert (codes.max(axis=1) == 1).all() and (codes.min(axis=1) == -1).all()
    for i, j in itertools.permutations(range(count), 2):
        separation = compute_separations(codes[i], codes[j : j + 1])[0]
        assert MAX_SHAPE_ANGLE_RAD * separation > PLACEMENT_TOLERANCE_RAD


@pytest.mark.parametrize("max_angle_rad", [0.45, 0.6])
def test_shape_codes_of_joints_with_small_travel_exceed_tolerance(max_angle_rad: float) -> None:
    codes = choose_codes(13, max_angle_rad)
    for i, j in itertools.permutations(range(13), 2):
        separation = compute_separations(codes[i], codes[j : j + 1])[0]
        assert max_angle_rad * separation > PLACEMENT_TOLERANCE_RAD


def test_shape_codes_of_18_joints_need_only_three_shapes() -> None:
    assert choose_codes(18).shape[1] == 3
    assert choose_codes(19).shape[1] == 4


@pytest.mark.parametrize("name", ["planar13", "mamba"])
def test_shapes_stay_within_limits_and_do_not_cross_themselves(name: str) -> None:
    robot = read_robot(name)
    for pose in design_poses(robot.joint_table):
        for joint, angle_rad in zip(robot.joint_table, pose.angle_rad, strict=True):
            assert joint.limits.lower_rad <= angle_rad <= joint.limits.upper_rad
            assert joint.axis == pose.axis or angle_rad == 0
        positions_mm = compute_joint_positions_mm(robot, pose)
        body_width_mm = 2000 * robot.module.radius_m
        for i, j in itertools.combinations(range(len(positions_mm)), 2):
            if j > i + 2:  # joints of links that are no neighbors
                assert np.linalg.norm(positions_mm[i] - positions_mm[j]) > body_width_mm


def test_shape_page_turns_left_for_yaw_right_for_pitch() -> None:
    robot = read_robot("mamba")
    for pose in design_poses(robot.joint_table):
        if pose.axis is None:
            continue
        positions_mm = compute_joint_positions_mm(robot, pose)
        steps_mm = np.diff(positions_mm, axis=0)
        bends_rad = np.diff(np.unwrap(np.arctan2(steps_mm[:, 1], steps_mm[:, 0])))
        direction = 1.0 if pose.axis == "yaw" else -1.0
        assert bends_rad == pytest.approx(direction * pose.angle_rad, abs=1e-9)


def test_shape_sheets_contain_every_joint_in_true_scale() -> None:
    robot = read_robot("planar13")
    poses = design_poses(robot.joint_table)
    sheet_mm = np.array((273.0, 186.0))
    shape = tile_shape(robot, poses[1], sheet_mm)
    min_corner_mm, max_corner_mm = shape.drawing.bounds_mm
    assert (min_corner_mm >= -1e-6).all()
    assert (max_corner_mm <= sheet_mm * (shape.column_count, shape.row_count) + 1e-6).all()
    spine_mm = next(stroke.points_mm for stroke in shape.drawing.strokes if stroke.dashed)
    lengths_mm = np.linalg.norm(np.diff(spine_mm, axis=0), axis=1)
    assert lengths_mm == pytest.approx(1000 * np.array(robot.link_lengths_m))
    for x_mm, y_mm in spine_mm.tolist():
        row = shape.row_count - 1 - int(y_mm // sheet_mm[1])
        column = int(x_mm // sheet_mm[0])
        assert (row, column) in shape.sheets


def test_shape_pdf_has_page_for_each_sheet_in_true_scale() -> None:
    robot = read_robot("planar13")
    poses = design_poses(robot.joint_table)
    pages = make_pages(robot, poses, "abc123", "a4")
    content = encode_pdf(pages, "shapes (1)")
    assert content.count(b"/Type /Page ") == len(pages)
    assert b"/PrintScaling /None" in content
    assert b"/Title (shapes \\(1\\))" in content
    width, height = map(float, re.findall(rb"MediaBox \[0 0 (\S+) (\S+)\]", content)[0])
    assert (width / POINTS_PER_MM, height / POINTS_PER_MM) == pytest.approx((297, 210), abs=0.01)
    start = content.index(b"stream\n", content.index(b"4 0 obj")) + len(b"stream\n")
    overview = zlib.decompress(content[start : content.index(b"\nendstream", start)])
    assert b"drawing abc123" in overview
    table_offset = int(content.split(b"startxref\n")[1].split()[0])
    assert content[table_offset : table_offset + 4] == b"xref"


def test_shape_svg_contains_all_shapes_in_millimeters() -> None:
    robot = read_robot("planar13")
    poses = design_poses(robot.joint_table)
    text = encode_svg(make_poster(robot, poses, "abc123"), "shapes <1>")
    width, height, view_box = re.findall(
        r'width="(\d+)mm" height="(\d+)mm" viewBox="0 0 (\d+ \d+)"', text
    )[0]
    assert f"{width} {height}" == view_box
    assert text.count("joint_13 ") == len(poses) - 1
    assert "shapes &lt;1&gt;" in text


def test_shape_drawing_mark_changes_with_angles() -> None:
    robot = read_robot("planar13")
    poses = design_poses(robot.joint_table)
    mark = compute_drawing_mark(robot, poses)
    assert len(mark) == 6
    assert mark == compute_drawing_mark(robot, design_poses(robot.joint_table))
    poses[1].angle_rad[0] += 0.01
    assert mark != compute_drawing_mark(robot, poses)


def test_shape_shows_each_angle_in_degrees() -> None:
    robot = read_robot("planar13")
    pose = design_poses(robot.joint_table)[1]
    texts = [label.text for label in draw_shape(robot, pose).labels]
    assert f"joint_1 {np.degrees(pose.angle_rad[0]):+.0f}°" in texts
