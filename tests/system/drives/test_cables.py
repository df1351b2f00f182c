"""A joint without end stops counts its revolutions over restarts, so that its cable is not wound too far."""

import json
import math
from pathlib import Path

import pytest

from snakesim_testing.benches.workbench import read_example_from_docs
from snakesim_testing.runs.bench_host import running_bench_host, write_lab_folder
from snakesim_testing.runs.hand_turned_robot import (
    BACKEND,
    HELD_BACKEND,
    JOINT_COUNT,
    SCENARIO,
    read_robot_file,
    wait_for_published_angle,
)
from snakesim_testing.runs.in_process_command import snakesim

pytestmark = pytest.mark.e2e
REVOLUTION_RAD = 2 * math.pi
JOINT_WITHOUT_END_STOPS = "\n[joints.joint_1]\nangle_rad = 3.0\ncable_turns = 0.6\n"


def set_drive_angle(home: Path, joint_1_rad: float) -> None:
    """Set the angle that the drive of joint_1 measures."""
    (home / "new.json").write_text(json.dumps([joint_1_rad, *[0.0] * (JOINT_COUNT - 1)]))
    (home / "new.json").replace(home / "drives.json")


def read_status(home: Path, endpoint: str) -> str:
    """Return the output of `snakesim status`."""
    return snakesim("status", "--endpoint", endpoint, cwd=home).out


def test_cable_revolution_lost_by_drive_is_still_counted(tmp_path: Path) -> None:
    driver = read_example_from_docs().replace("emulated=True", "emulated=False") + HELD_BACKEND
    folder = write_lab_folder(tmp_path, JOINT_COUNT, SCENARIO, {"held.py": driver})
    with (folder / "snake.toml").open("a") as file:
        file.write(JOINT_WITHOUT_END_STOPS)
    set_drive_angle(tmp_path, 0.0)
    with running_bench_host(tmp_path, BACKEND) as endpoint:
        assert "joint_1: how far its cable is wound is not known" in read_status(tmp_path, endpoint)
        declared = snakesim(
            "robot",
            "calibrate",
            "zero",
            "snake.toml",
            "--now",
            "--endpoint",
            endpoint,
            cwd=tmp_path,
        )
        assert declared.code == 0, declared.printed
        assert "its cable counts as unwound here" in declared.out, declared.printed
    assert read_robot_file(tmp_path).joint_table[0].limits.cable_unwound
    with running_bench_host(tmp_path, BACKEND) as endpoint:
        assert "cable" not in read_status(tmp_path, endpoint)
        for angle_rad in (2.0, 4.0):  # a person turns the joint
            set_drive_angle(tmp_path, angle_rad)
            wait_for_published_angle(tmp_path, endpoint, angle_rad)
    # The drive has lost a revolution, because it was switched off and on.
    set_drive_angle(tmp_path, 4.0 - REVOLUTION_RAD)
    with running_bench_host(tmp_path, BACKEND) as endpoint:
        status = read_status(tmp_path, endpoint)
        assert "it is at +4.00 rad by the turns counted over restarts" in status, status
        assert "Turn it by hand by 1 turn to lower angles" in status
