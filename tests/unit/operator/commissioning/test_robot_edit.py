"""Compares a robot file with the robot of a host, and changes it in place."""

import stat
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import SHIPPED_FILES_DIR, decode_table, read_table_with_base
from snakesim_hal.model.robot_file.checked import PROPERTIES, StartCheckRecord
from snakesim_hal.model.robot_file.robot import RobotFile, restrict_drive_modes
from snakesim_operator.features.commissioning.robot_edit import (
    read_joints_with_drive_modes,
    write_check_record,
    write_joint_fields,
)
from snakesim_testing.messages import raises_error


@pytest.mark.parametrize(
    ("change", "is_same"), [("", True), ("\n[joints.joint_2]\nsign = -1\n", False)]
)
def test_robot_edit_drives_of_running_robot_match_the_edited_file(
    tmp_path: Path, change: str, is_same: bool
) -> None:
    path = tmp_path / "snake.toml"
    path.write_text((SHIPPED_FILES_DIR / "robots" / "planar13.toml").read_text())
    robot_file = decode_table(read_table_with_base(str(path), "robots"), RobotFile)
    running_joints = restrict_drive_modes(robot_file, ("position", "torque")).joint_table
    path.write_text(path.read_text() + change)
    edited_joints = read_joints_with_drive_modes(path, running_joints)
    edited_drives = [joint.drive for joint in edited_joints]
    running_drives = [joint.drive for joint in running_joints]
    assert (edited_drives == running_drives) is is_same


def test_robot_edit_follows_symbolic_link_and_keeps_permissions_and_text(tmp_path: Path) -> None:
    (tmp_path / "robots.git").mkdir()
    target = tmp_path / "robots.git" / "snake.toml"
    link = tmp_path / "snake.toml"
    target.write_text('extends = "planar13" # ours\nname = "snake"\n')
    target.chmod(0o640)
    link.symlink_to(target)
    write_joint_fields(link, {"joint_1": {"zero_rad": 0.25}}, "straight pose")
    assert link.is_symlink()
    assert "zero_rad = 0.25" in target.read_text()
    assert "# ours" in target.read_text()
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "robots.git",
        "snake.toml",
        "snake.toml",
    ]


def test_robot_edit_invalid_change_leaves_file_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "snake.toml"
    path.write_text('extends = "planar13"\nname = "snake"\n')
    before = path.read_bytes()
    with raises_error(ConfigError, code="config/out-of-range"):
        write_joint_fields(path, {"joint_1": {"gear": -1.0}}, "by mistake")
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["snake.toml"]


def test_robot_edit_checks_are_read_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "snake.toml"
    path.write_text('extends = "planar13"\nname = "snake"\n')
    check_record = StartCheckRecord(
        by="anna",
        on="2026-11-24",
        joints="5b2c4b1d9e0f7a36",
        backend="can",
        confirmed=list(PROPERTIES),
        by_hand={"sign": ["joint_1"], "gear": ["joint_1", "joint_2"]},
        straight=True,
        allowed_backlash_rad=0.02,
    )
    for _ in range(2):  # the second record replaces the first
        write_check_record(path, check_record)
        robot_file = decode_table(read_table_with_base(str(path), "robots"), RobotFile)
        assert robot_file.checked == check_record
