"""A robot of emulated servos that measure only joint angles and currents runs on estimates of pose and contacts."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import REPORT_FILENAME
from snakesim_testing.runs.in_process_command import snakesim

SCRIPT = Path(__file__).parents[3] / "examples" / "without_sensors.py"
# These servos have no contact sensors, whatever the robot file says.
WITHOUT_IMU = [
    *("triplet", "--backend", "dynamixel", "--duration", "2.5", "--in-process"),
    *("--unset", "robot.sensors.imu"),
]


@pytest.mark.slow
def test_drives_without_force_sensors_and_mocap_run_on_estimates(tmp_path: Path) -> None:
    """The pose sensor of the first run measures how far the robot moved, but guidance does not use it."""
    ignore_pose = ("--set", "mission.localization=dead_reckoning")
    no_pose = ("--unset", "robot.sensors.pose")
    with_sensor = snakesim("run", *WITHOUT_IMU, *ignore_pose, "--out", "with", cwd=tmp_path)
    without_sensor = snakesim("run", *WITHOUT_IMU, *no_pose, "--out", "without", cwd=tmp_path)
    assert with_sensor.code == 0, with_sensor.out + with_sensor.err
    assert without_sensor.code == 0, without_sensor.out + without_sensor.err
    summary_with = json.loads((tmp_path / "with" / "summary.json").read_text())
    summary_without = json.loads((tmp_path / "without" / "summary.json").read_text())
    assert summary_with["command_digest"] == summary_without["command_digest"], (
        "guidance used the pose sensor"
    )
    assert summary_with["path_distance_m"] > 0.1
    assert summary_with["dead_reckoning_error_m"] < 0.1
    assert summary_without["path_distance_m"] is None
    assert summary_without["dead_reckoned_distance_m"] > 0.1
    assert summary_without["pose_from"] == "dead_reckoning"
    assert summary_without["contacts_from"] == "joint_torques"
    assert summary_without["peak_contact_force_n"] is None, "the robot has no force sensor"
    for text in (without_sensor.out, (tmp_path / "without" / REPORT_FILENAME).read_text()):
        assert "pose is estimated by dead reckoning" in text
        assert "contacts are estimated from joint torques" in text
    worlds = RunRecord.load(tmp_path / "without").worlds
    for world in worlds:
        assert world.pose_timestamp_ns is None
        assert world.base_position_sd_m is not None
    contacts = [contact for world in worlds for contact in world.contacts]
    assert contacts
    for contact in contacts:
        assert contact.obstacle is not None
        assert contact.confidence < 1.0


@pytest.mark.slow
def test_example_without_sensors_prints_every_driver_type() -> None:
    command = [sys.executable, str(SCRIPT), "4", "1"]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=590)
    assert result.returncode == 0, result.stderr
    rows = re.findall(
        r"^(\w+) +(.+?) +moved +([0-9.]+) m, pose (.+?), .*, complete$", result.stdout, re.MULTILINE
    )
    assert [row[0] for row in rows] == ["can"] * 4 + ["odrive"] * 2 + ["moteus", "dynamixel"], (
        result.stdout
    )
    assert all(float(advance_m) > 0.2 for _, _, advance_m, _ in rows), result.stdout
    pose_sources = [pose for _, sensors, _, pose in rows if "alone" in sensors]
    assert pose_sources
    assert "measured" not in pose_sources
