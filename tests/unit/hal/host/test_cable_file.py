"""How far the cables of joints without end stops are wound, over restarts: what the next host knows, and refuses."""

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
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.robot import RobotFile, describe_robot
from snakesim_hal.wire.messages import RobotDescription
from snakesim_testing.hal.small_robots import make_joint_state
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

DECLARED = "2026-11-25T02:40:12+00:00"
NOW_S = datetime(2026, 11, 25, 2, 50, tzinfo=UTC).timestamp()
LATER_S = NOW_S + 10 * MAX_DECLARATION_AGE_S
TURN = 2 * math.pi


def file_of(folder: Path, joint_2: str, extra: str = "") -> RobotFile:
    shipped = (
        (SHIPPED_FILES_DIR / "robots" / "planar13.toml")
        .read_text()
        .replace("modules = 13", "modules = 3")
    )
    path = folder / "snake.toml"
    path.write_text(f"{shipped}\n[joints.joint_2]\nangle_rad = 3.0\n{joint_2}\n{extra}")
    return decode_table(read_table_with_base(str(path), "robots"), RobotFile)


class Bench:
    """A robot whose joint_2 has no end stops, and a folder for what its hosts keep."""

    def __init__(
        self, folder: Path, joint_2: str = f'cable_turns = 0.6\ncable_unwound = "{DECLARED}"'
    ) -> None:
        self.folder = folder
        self.joints: list[Joint] = []
        self.robot: RobotDescription
        self.serial = "A1"
        self.file(joint_2)

    def file(self, joint_2: str) -> None:
        robot = file_of(self.folder, joint_2)
        described = describe_robot(
            robot, backend="real", period_ns=10**7, lease_ns=5 * 10**7, config_hash="x"
        )
        self.joints, self.robot = (
            robot.joint_table,
            msgspec.structs.replace(described, emulated=False),
        )

    def host(self, *angles_rad: float, now_s: float = NOW_S, ends: bool = True) -> list[str]:
        """One that sees joint_2 at these angles of its drive, one after the other; why it does not arm in the end."""
        serials = [
            msgspec.structs.replace(joint, serial=self.serial) for joint in self.robot.joints
        ]
        others = writers()
        kept = CableFile(
            self.folder, self.joints, msgspec.structs.replace(self.robot, joints=serials), now_s
        )
        for angle_rad in angles_rad:
            kept.update(make_joint_state(self.robot, [0.0, angle_rad, 0.0]))
        against = kept.tracker.list_arming_obstacles()
        if ends:
            kept.close()  # on a computer that stutters a disk may take longer than a host waits for it
            wait_until(lambda: writers() <= others, "the file, written")
        return against


def writers() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "cables"}


def test_cable_turns_are_known_after_drive_forgot_them(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert bench.host(0.1, 1.5, 3.0, 4.0) == []  # by hand; within its limits it comes back
    (refused,) = bench.host(4.0 - TURN, now_s=LATER_S)
    assert (
        "joint_2: its drive reports -2.28 rad, but it is at +4.00 rad by the turns counted over restarts"
        in refused
    )
    assert (
        "wound by up to 1.48 turns, and `cable_turns` = 0.6. Turn it by hand by 1 turn to lower angles"
        in refused
    )
    # Its drive counts on.
    assert bench.host(4.0 - TURN, 2.0 - TURN, -TURN, -2.0 - TURN, now_s=LATER_S) != []
    assert bench.host(-2.0, now_s=LATER_S) == []  # and has forgotten that turn, too


def test_a_cable_that_bears_the_turn_is_no_reason(tmp_path: Path) -> None:
    bench = Bench(tmp_path, f'cable_turns = 1.5\ncable_unwound = "{DECLARED}"')
    assert bench.host(0.0, 2.0, 4.0) == [] == bench.host(4.0 - TURN, now_s=LATER_S)
    assert bench.host(4.0 - TURN, 6.0 - TURN, 8.0 - TURN, 10.0 - TURN, now_s=LATER_S) == []
    assert "by 2 turns" in bench.host(10.0 - 2 * TURN, now_s=LATER_S)[0]


def test_cable_turns_without_record_are_unknown_until_declared(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "cable_turns = 0.6")
    (refused,) = bench.host(0.0)
    assert "joint_2: how far its cable is wound is not known: no host before this one" in refused
    assert "`snakesim robot calibrate zero`" in refused
    bench.file(f'cable_turns = 0.6\ncable_unwound = "{DECLARED}"')
    # Long ago: who knows what was turned since.
    assert "declared unwound at" in bench.host(0.0, now_s=LATER_S)[0]
    assert bench.host(0.0) == [] == bench.host(0.1, now_s=LATER_S)


@pytest.mark.parametrize("change", ["drive", "sign", "zero"])
def test_cable_record_counts_only_for_same_drive_and_mounting(tmp_path: Path, change: str) -> None:
    bench = Bench(tmp_path)
    assert bench.host(0.0) == []
    declared = f'cable_turns = 0.6\ncable_unwound = "{DECLARED}"'
    bench.serial = "B9" if change == "drive" else "A1"
    bench.file(declared + {"drive": "", "sign": "\nsign = -1", "zero": "\nzero_rad = 0.5"}[change])
    assert "of another drive, sign or zero" in bench.host(0.0, now_s=LATER_S)[0]


def test_cable_record_survives_kill_and_unreadable_file_is_unknown(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert bench.host(*(0.05 * step for step in range(80)), ends=False) == []
    path = tmp_path / CABLE_FILENAME
    wait_until(lambda: path.is_file() and b":3." in path.read_bytes(), "what it keeps, on the disk")
    assert "Turn it by hand" in bench.host(3.95 - TURN, now_s=LATER_S)[0]
    path.write_text("{")
    assert "cannot be read" in bench.host(0.0, now_s=LATER_S)[0]


def test_cable_turns_are_counted_only_for_declared_real_joints(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert (
        open_cable_file(tmp_path, bench.joints, msgspec.structs.replace(bench.robot, emulated=True))
        is None
    )
    bench.file("angle_max_rad = 3.1415\nangle_min_rad = -3.1415")
    no_stops = open_cable_file(tmp_path, bench.joints, bench.robot)
    assert no_stops is not None
    assert "leave no room for end stops" in no_stops.tracker.list_arming_obstacles()[0]
    bench.file("")
    assert open_cable_file(tmp_path, bench.joints, bench.robot) is None


@pytest.mark.parametrize(
    "joint_2",
    ["cable_turns = 0.4", "cable_turns = 0.6\ngear = 9.0"],
)
def test_cable_shorter_than_limits_or_geared_is_refused(tmp_path: Path, joint_2: str) -> None:
    with raises_error(ConfigError, code="config/invalid-value"):
        file_of(tmp_path, joint_2)
