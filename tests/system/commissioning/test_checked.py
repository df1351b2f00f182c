"""A real robot is armed once its joints were checked, or by an explicit word; not after its file or drives changed."""

from pathlib import Path

import pytest

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.checked_robot import JOINT_COUNT, make_checked_folder
from snakesim_testing.runs.command import CompletedRun, snakesim


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return make_checked_folder(tmp_path)


def run(home: Path, out: str, *words: str) -> CompletedRun:
    flags = ("--backend", "./real.py:Real", "--out", out, "--endpoint", find_free_endpoint())
    return snakesim("run", "bench.toml", *flags, *words, cwd=home)


def moves(home: Path, out: str, *words: str) -> bool:
    return run(home, out, "--duration", "0.1", *words).code == 0


@pytest.mark.slow
def test_checked_robot_can_be_armed_until_file_or_drive_changes(home: Path) -> None:
    refused = run(home, "never", "--duration", "0.1")
    assert refused.code == 1
    assert "its joints have not been checked against its file" in refused.out
    assert moves(home, "word", "--unchecked")

    checking = run(home, "check", "--controller", "joint_check", "--duration", "10")
    assert checking.code == 0, checking.out
    judged = snakesim("robot", "check", "check", "--write", "snake.toml", "--straight", cwd=home)
    assert (
        judged.code == 0
        and f"{JOINT_COUNT} of {JOINT_COUNT} joints match the robot file" in judged.out
    ), judged.out
    text = (home / "snake.toml").read_text()
    assert "[checked]" in text
    assert 'serials = ["A1", "B2", "C3"]' in text
    assert moves(home, "checked")
    assert moves(home, "slower", "--set", "robot.limits.speed_rad_s=1.0")

    (home / "serials").write_text("A1 B9 C3")
    other = run(home, "other", "--duration", "0.1")
    assert other.code == 1
    assert "joint_2 has drive B9, and had B2" in other.out
    (home / "serials").write_text("A1 B2 C3")
    (home / "snake.toml").write_text(f"{text}\n[joints.joint_2]\nsign = -1\n")
    changed = run(home, "changed", "--duration", "0.1")
    assert changed.code == 1
    assert "how its joints are mounted was changed in its file since" in changed.out
    again = snakesim("robot", "check", "check", "--write", "snake.toml", "--straight", cwd=home)
    assert again.code == 2
    assert "the mounting of the joints differs" in again.err
