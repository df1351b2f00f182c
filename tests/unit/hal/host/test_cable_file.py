"""A host stores how far cables of joints without end stops are wound, and the next host uses the record."""

import math
import threading
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.host.cable_file import (
    CABLE_FILENAME,
    MAX_DECLARATION_AGE_S,
    CableFile,
    open_cable_file,
)
from snakesim_hal.model.files import SHIPPED_FILES_DIR, decode_table, read_table_with_base
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import RobotFile, describe_robot
from snakesim_hal.wire.messages import RobotDescription
from snakesim_testing.hal.small_robots import make_joint_state
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

DECLARED_TIME = "2026-11-25T02:40:12+00:00"
NOW_S = datetime(2026, 11, 25, 2, 50, tzinfo=UTC).timestamp()
LATER_S = NOW_S + 10 * MAX_DECLARATION_AGE_S
TURN_RAD = 2 * math.pi
ANGLE_LIMIT_RAD = 3.0  # of joint_2, to either side


def make_robot_with(folder: Path, joint_2: str, extra: str = "") -> RobotFile:
    """Write and read a robot file with three joints, and these keys of joint_2."""
    shipped = (
        (SHIPPED_FILES_DIR / "robots" / "planar13.toml")
        .read_text()
        .replace("modules = 13", "modules = 3")
    )
    path = folder / "snake.toml"
    path.write_text(
        f"{shipped}\n[joints.joint_2]\nangle_rad = {ANGLE_LIMIT_RAD}\n{joint_2}\n{extra}"
    )
    return decode_table(read_table_with_base(str(path), "robots"), RobotFile)


class CableRig:
    """A robot whose joint_2 has no end stops, and a folder for the records of its hosts."""

    def __init__(
        self, folder: Path, joint_2: str = f'cable_turns = 0.6\ncable_unwound = "{DECLARED_TIME}"'
    ) -> None:
        self.folder = folder
        self.joints: list[Joint] = []
        self.robot: RobotDescription
        self.serial = "A1"
        self.write_robot_file(joint_2)

    def write_robot_file(self, joint_2: str) -> None:
        robot = make_robot_with(self.folder, joint_2)
        described = describe_robot(
            robot, backend="real", period_ns=10**7, lease_ns=5 * 10**7, config_hash="x"
        )
        self.joints = robot.joint_table
        self.robot = msgspec.structs.replace(described, emulated=False)

    def run_host(
        self, *drive_angles_rad: float, now_s: float = NOW_S, closes: bool = True
    ) -> list[str]:
        """Run a host while the drive of joint_2 reports these angles, and return why the host does not arm.

        The host reads the record that the host before it has left, and leaves one for the next.
        """
        serials = [
            msgspec.structs.replace(joint, serial=self.serial) for joint in self.robot.joints
        ]
        other_writers = list_writers()
        cable_file = CableFile(
            self.folder, self.joints, msgspec.structs.replace(self.robot, joints=serials), now_s
        )
        for angle_rad in drive_angles_rad:
            cable_file.update(make_joint_state(self.robot, [0.0, angle_rad, 0.0]))
        obstacles = cable_file.tracker.list_arming_obstacles()
        if closes:
            cable_file.close()  # a slow disk may take longer than a host waits for it
            wait_until(lambda: list_writers() <= other_writers, "the file is written")
        return obstacles


def list_writers() -> set[threading.Thread]:
    """Return the threads that write cable files."""
    return {thread for thread in threading.enumerate() if thread.name == "cables"}


def test_cable_turns_lost_by_the_drive_prevent_arming(tmp_path: Path) -> None:
    """A drive that was off reports an angle that is whole turns too low, but the record of the last host has them."""
    cable_turns = 0.6  # that the cable bears to either side
    rig = CableRig(tmp_path, f'cable_turns = {cable_turns}\ncable_unwound = "{DECLARED_TIME}"')
    wound_rad = 4.0  # beyond ANGLE_LIMIT_RAD, because the joint is turned by hand
    assert rig.run_host(0.1, 1.5, 3.0, wound_rad) == [], "the first host may arm"

    drive_rad = wound_rad - TURN_RAD  # the drive was off between the hosts, and has lost one turn
    (obstacle,) = rig.run_host(drive_rad, now_s=LATER_S)

    assert (
        f"joint_2: its drive reports {drive_rad:+.2f} rad, but it is at {wound_rad:+.2f} rad "
        "by the turns counted over restarts"
    ) in obstacle
    # The motor could turn until the drive reports ANGLE_LIMIT_RAD, which is one turn more for the cable.
    max_winding_turns = (ANGLE_LIMIT_RAD + TURN_RAD) / TURN_RAD
    assert (
        f"wound by up to {max_winding_turns:.2f} turns, and `cable_turns` = {cable_turns}. "
        "Turn it by hand by 1 turn to lower angles"
    ) in obstacle


def test_cable_turned_back_allows_arming_after_drive_restart(tmp_path: Path) -> None:
    """A drive that has lost a turn reports the true angle again if the joint is unwound while it restarts."""
    rig = CableRig(tmp_path)
    wound_rad = 4.0
    unwound_rad = (
        -2.0
    )  # within half a turn of zero, where a drive that starts reports the true angle
    assert rig.run_host(0.1, 1.5, 3.0, wound_rad) == [], "the first host may arm"

    turned_back_by_hand_rad = [wound_rad, 2.0, 0.0, unwound_rad]
    drive_rad = [
        angle_rad - TURN_RAD for angle_rad in turned_back_by_hand_rad
    ]  # it has lost a turn
    assert rig.run_host(*drive_rad, now_s=LATER_S) != [], "the drive reports the wrong turn"

    assert rig.run_host(unwound_rad, now_s=LATER_S) == [], "the drive has restarted"


def test_cable_turns_within_the_declared_range_allow_arming(tmp_path: Path) -> None:
    rig = CableRig(tmp_path, f'cable_turns = 1.5\ncable_unwound = "{DECLARED_TIME}"')
    assert rig.run_host(0.0, 2.0, 4.0) == [] == rig.run_host(4.0 - TURN_RAD, now_s=LATER_S)
    assert (
        rig.run_host(4.0 - TURN_RAD, 6.0 - TURN_RAD, 8.0 - TURN_RAD, 10.0 - TURN_RAD, now_s=LATER_S)
        == []
    )
    assert "by 2 turns" in rig.run_host(10.0 - 2 * TURN_RAD, now_s=LATER_S)[0]


def test_cable_turns_without_record_are_unknown_until_declared(tmp_path: Path) -> None:
    rig = CableRig(tmp_path, "cable_turns = 0.6")
    (obstacle,) = rig.run_host(0.0)
    assert "joint_2: how far its cable is wound is not known: no host before this one" in obstacle
    assert "`snakesim robot calibrate zero`" in obstacle
    rig.write_robot_file(f'cable_turns = 0.6\ncable_unwound = "{DECLARED_TIME}"')
    # The declaration is too old, because the joint may have moved since.
    assert "declared unwound at" in rig.run_host(0.0, now_s=LATER_S)[0]
    assert rig.run_host(0.0) == [] == rig.run_host(0.1, now_s=LATER_S)


@pytest.mark.parametrize("change", ["drive", "sign", "zero"])
def test_cable_record_counts_only_for_same_drive_and_mounting(tmp_path: Path, change: str) -> None:
    rig = CableRig(tmp_path)
    assert rig.run_host(0.0) == []
    keys = f'cable_turns = 0.6\ncable_unwound = "{DECLARED_TIME}"'
    rig.serial = "B9" if change == "drive" else "A1"
    rig.write_robot_file(
        keys + {"drive": "", "sign": "\nsign = -1", "zero": "\nzero_rad = 0.5"}[change]
    )
    assert "of another drive, sign or zero" in rig.run_host(0.0, now_s=LATER_S)[0]


def test_cable_record_survives_kill_and_unreadable_file_is_unknown(tmp_path: Path) -> None:
    rig = CableRig(tmp_path)
    assert rig.run_host(*(0.05 * step for step in range(80)), closes=False) == []
    path = tmp_path / CABLE_FILENAME
    wait_until(lambda: path.is_file() and b":3." in path.read_bytes(), "the record is on the disk")
    assert "Turn it by hand" in rig.run_host(3.95 - TURN_RAD, now_s=LATER_S)[0]
    path.write_text("{")
    assert "cannot be read" in rig.run_host(0.0, now_s=LATER_S)[0]


def test_cable_turns_are_counted_only_for_declared_real_joints(tmp_path: Path) -> None:
    rig = CableRig(tmp_path)
    assert (
        open_cable_file(tmp_path, rig.joints, msgspec.structs.replace(rig.robot, emulated=True))
        is None
    )
    rig.write_robot_file("angle_max_rad = 3.1415\nangle_min_rad = -3.1415")
    cable_file = open_cable_file(tmp_path, rig.joints, rig.robot)
    assert cable_file is not None
    assert "leave no room for end stops" in cable_file.tracker.list_arming_obstacles()[0]
    rig.write_robot_file("")
    assert open_cable_file(tmp_path, rig.joints, rig.robot) is None


@pytest.mark.parametrize(
    "joint_2",
    ["cable_turns = 0.4", "cable_turns = 0.6\ngear = 9.0"],
)
def test_cable_shorter_than_limits_or_geared_is_refused(tmp_path: Path, joint_2: str) -> None:
    with raises_error(ConfigError, code="config/invalid-value"):
        make_robot_with(tmp_path, joint_2)
