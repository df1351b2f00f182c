"""A robot of emulated servos that tells joint angles and currents alone gets along; nobody else's reading is used."""

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
SHORT = ["triplet", "--backend", "dynamixel", "--duration", "2.5", "--in-process"]
# And these servos have no contact sensors, whatever the file says.
BARE = [*SHORT, "--unset", "robot.sensors.imu"]


@pytest.mark.slow
def test_drives_without_force_sensors_and_mocap_run_on_estimates(tmp_path: Path) -> None:
    watched = [*BARE, "--set", "mission.localization=dead_reckoning", "--out", "watched"]
    blind = [*BARE, "--unset", "robot.sensors.pose", "--out", "blind"]
    ended = {
        name: snakesim("run", *words, cwd=tmp_path)
        for name, words in (("watched", watched), ("blind", blind))
    }
    said = {name: json.loads((tmp_path / name / "summary.json").read_text()) for name in ended}
    assert all(one.code == 0 for one in ended.values()), ended["blind"].out + ended["blind"].err
    assert said["watched"]["command_digest"] == said["blind"]["command_digest"], (
        "guidance has looked at the pose"
    )
    assert said["watched"]["path_distance_m"] > 0.1
    assert said["watched"]["dead_reckoning_error_m"] < 0.1
    assert said["blind"]["path_distance_m"] is None
    assert said["blind"]["dead_reckoned_distance_m"] > 0.1
    assert said["blind"]["pose_from"] == "dead_reckoning"
    assert said["blind"]["contacts_from"] == "joint_torques"
    assert said["blind"]["peak_contact_force_n"] is None, "nobody has measured a force"
    for text in (ended["blind"].out, (tmp_path / "blind" / REPORT_FILENAME).read_text()):
        assert "pose is estimated by dead reckoning" in text
        assert "contacts are estimated from joint torques" in text
    worlds = RunRecord.load(tmp_path / "blind").worlds
    assert all(
        world.pose_timestamp_ns is None and world.base_position_sd_m is not None for world in worlds
    )
    felt = [contact for world in worlds for contact in world.contacts]
    assert felt
    assert all(contact.obstacle is not None and contact.confidence < 1.0 for contact in felt)


@pytest.mark.slow
def test_the_table_has_every_family_side_by_side() -> None:
    command = [sys.executable, str(SCRIPT), "4", "1"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=590)
    assert ended.returncode == 0, ended.stderr
    rows = re.findall(
        r"^(\w+) +(.+?) +moved +([0-9.]+) m, pose (.+?), .*, complete$", ended.stdout, re.MULTILINE
    )
    assert [row[0] for row in rows] == ["can"] * 4 + ["odrive"] * 2 + ["moteus", "dynamixel"], (
        ended.stdout
    )
    assert all(float(row[2]) > 0.2 for row in rows), ended.stdout
    assert {row[3] == "measured" for row in rows if "alone" in row[1]} == {False}
