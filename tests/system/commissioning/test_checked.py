"""A real robot can be armed after its joints were checked, until its file or drives change, or with `--unchecked`."""

from pathlib import Path

import pytest

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.checked_robot import JOINT_COUNT, make_checked_folder
from snakesim_testing.runs.command import CompletedRun, snakesim


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Make a folder with a real robot whose joints were never checked."""
    return make_checked_folder(tmp_path)


def run_real_robot(home: Path, out: str, *options: str) -> CompletedRun:
    """Run the robot to its end, and return the completed command."""
    flags = ("--backend", "./real.py:Real", "--out", out, "--endpoint", find_free_endpoint())
    return snakesim("run", "bench.toml", *flags, *options, cwd=home)


def can_be_armed(home: Path, out: str, *options: str) -> bool:
    """Return whether a short run of the robot succeeds."""
    return run_real_robot(home, out, "--duration", "0.1", *options).code == 0


@pytest.mark.slow
def test_checked_robot_can_be_armed_until_file_or_drive_changes(home: Path) -> None:
    refused = run_real_robot(home, "never", "--duration", "0.1")
    assert refused.code == 1
    assert "its joints have not been checked against its file" in refused.out
    assert can_be_armed(home, "word", "--unchecked")

    check_run = run_real_robot(home, "check", "--controller", "joint_check", "--duration", "10")
    assert check_run.code == 0, check_run.out
    check = snakesim("robot", "check", "check", "--write", "snake.toml", "--straight", cwd=home)
    assert check.code == 0, check.out
    assert f"{JOINT_COUNT} of {JOINT_COUNT} joints match the robot file" in check.out, check.out
    text = (home / "snake.toml").read_text()
    assert "[checked]" in text
    assert 'serials = ["A1", "B2", "C3"]' in text
    assert can_be_armed(home, "checked")
    assert can_be_armed(home, "slower", "--set", "robot.limits.speed_rad_s=1.0")

    (home / "serials").write_text("A1 B9 C3")
    exchanged = run_real_robot(home, "other", "--duration", "0.1")
    assert exchanged.code == 1
    assert "joint_2 has drive B9, and had B2" in exchanged.out
    (home / "serials").write_text("A1 B2 C3")
    (home / "snake.toml").write_text(f"{text}\n[joints.joint_2]\nsign = -1\n")
    changed = run_real_robot(home, "changed", "--duration", "0.1")
    assert changed.code == 1
    assert "how its joints are mounted was changed in its file since" in changed.out
    second_check = snakesim(
        "robot", "check", "check", "--write", "snake.toml", "--straight", cwd=home
    )
    assert second_check.code == 2
    assert "the mounting of the joints differs" in second_check.err
