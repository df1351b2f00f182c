"""Whether a robot file is the one that a host was started with."""

from pathlib import Path

import pytest

from snakesim_hal.model.files import SHIPPED, decode, read_part
from snakesim_hal.model.robot import RobotFile, with_modes
from snakesim_operator.commissioning.robot_edit import joints_on_drives


@pytest.mark.parametrize(("changed", "same"), [("", True), ("\n[joints.joint_2]\nsign = -1\n", False)])
def test_drives_without_a_mode_that_the_file_names_are_of_the_same_robot(
    tmp_path: Path, changed: str, same: bool
) -> None:
    path = tmp_path / "snake.toml"
    path.write_text((SHIPPED / "robots" / "planar13.toml").read_text())
    running = with_modes(decode(read_part(str(path), "robots"), RobotFile), ("position", "torque")).joint_table
    path.write_text(path.read_text() + changed)
    assert ([joint.drive for joint in joints_on_drives(path, running)] == [joint.drive for joint in running]) is same
