"""A joint without end stops over restarts of host and drives: its cable is not wound further than its file allows."""

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
TURN = 2 * math.pi
ENDLESS = "\n[joints.joint_1]\nangle_rad = 3.0\ncable_turns = 0.6\n"


def drives(home: Path, joint_1_rad: float) -> None:
    """What the drives say."""
    (home / "new.json").write_text(json.dumps([joint_1_rad, *[0.0] * (JOINT_COUNT - 1)]))
    (home / "new.json").replace(home / "drives.json")


def why(home: Path, endpoint: str) -> str:
    return snakesim("status", "--endpoint", endpoint, cwd=home).out


def test_cable_turn_forgotten_by_its_drive_is_not_repeated(tmp_path: Path) -> None:
    held = read_example_from_docs().replace("emulated=True", "emulated=False") + HELD_BACKEND
    with (write_lab_folder(tmp_path, JOINT_COUNT, SCENARIO, {"held.py": held}) / "snake.toml").open(
        "a"
    ) as file:
        file.write(ENDLESS)
    drives(tmp_path, 0.0)
    with running_bench_host(tmp_path, BACKEND) as endpoint:
        assert "joint_1: how far its cable is wound is not known" in why(tmp_path, endpoint)
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
        assert declared.code == 0 and "its cable counts as unwound here" in declared.out, (
            declared.printed
        )
    assert read_robot_file(tmp_path).joint_table[0].limits.cable_unwound
    with running_bench_host(tmp_path, BACKEND) as endpoint:
        assert "cable" not in why(tmp_path, endpoint)
        for angle_rad in (2.0, 4.0):  # somebody turns it through
            drives(tmp_path, angle_rad)
            wait_for_published_angle(tmp_path, endpoint, angle_rad)
    drives(tmp_path, 4.0 - TURN)  # it was switched off and on
    with running_bench_host(tmp_path, BACKEND) as endpoint:
        shown = why(tmp_path, endpoint)
        assert "it is at +4.00 rad by the turns counted over restarts" in shown, shown
        assert "Turn it by hand by 1 turn to lower angles" in shown
