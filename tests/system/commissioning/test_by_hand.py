"""`snakesim robot calibrate zero|direction|gear|limits`, on a host whose drives somebody turns by hand."""

import json
import subprocess
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest

from snakesim_testing.runs.bench_host import running_bench_host
from snakesim_testing.runs.command import run_in_background, running_snakesim
from snakesim_testing.runs.hand_turned_robot import (
    BACKEND,
    JOINT_COUNT,
    make_hand_turned_folder,
    read_robot_file,
    wait_for_published_angle,
)
from snakesim_testing.runs.in_process_command import snakesim

# As it is really mounted.
SIGN, ZERO_RAD = np.array([1.0, -1.0, 1.0, 1.0]), np.array([0.3, -0.2, 0.0, 0.1])


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return make_hand_turned_folder(tmp_path)


def set_joint_angles(home: Path, joints_rad: Sequence[float]) -> None:
    """Hold the joints at angles, which the drives show as they are mounted."""
    drives = ZERO_RAD + SIGN * np.array(joints_rad)
    (home / "new.json").write_text(json.dumps(drives.tolist()))
    (home / "new.json").replace(home / "drives.json")


def calibrating(
    home: Path, endpoint: str, *words: str
) -> AbstractContextManager[subprocess.Popen[str]]:
    """A command that somebody answers by moving joints and pressing Enter."""
    return run_in_background(
        home, "robot", "calibrate", *words, "--endpoint", endpoint, stdin=subprocess.PIPE
    )


def read_output_line(process: subprocess.Popen[str]) -> str:
    """The next that it says."""
    assert process.stdout is not None
    return process.stdout.readline()


def enter(process: subprocess.Popen[str]) -> str:
    """Press Enter; what it says then, to its end."""
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return process.communicate(timeout=30)[0]


def test_what_hands_do_ends_up_in_the_robot_file(home: Path) -> None:
    pose_rad = [0.0] * JOINT_COUNT
    set_joint_angles(home, pose_rad)
    with running_bench_host(home, BACKEND) as endpoint:
        with calibrating(home, endpoint, "direction", "snake.toml") as process:
            for joint in range(JOINT_COUNT):
                assert read_output_line(process).startswith(
                    f"joint_{joint + 1}: turn the link in front of it to the left"
                )
                pose_rad[joint] += 0.3
                set_joint_angles(home, pose_rad)
                assert (
                    "the other way round" if SIGN[joint] < 0 else "matches the file"
                ) in read_output_line(process)
            assert "1 joints changed" in read_output_line(process)
            assert process.wait(20) == 0
        stale = snakesim(
            "robot", "calibrate", "zero", "snake.toml", "--now", "--endpoint", endpoint, cwd=home
        )
        assert stale.code == 2
        assert "restart the host with this file" in stale.err
    set_joint_angles(home, [0.0] * JOINT_COUNT)
    with running_bench_host(home, BACKEND) as endpoint:
        with calibrating(home, endpoint, "limits", "snake.toml", "joint_1") as process:
            assert read_output_line(process).startswith("Move each joint")
            for angle_rad in (-0.9, 1.2):
                set_joint_angles(home, [angle_rad, 0.0, 0.0, 0.0])
                wait_for_published_angle(home, endpoint, angle_rad + ZERO_RAD[0])
            assert "1 joints changed" in enter(process)
        assert "joint_2 reports the turn" in swapped(home, endpoint)
        with calibrating(
            home, endpoint, "gear", "snake.toml", "joint_3", "--degrees", "45"
        ) as process:
            assert read_output_line(process).startswith(
                "joint_3: turn the link in front of it to the left by 45 degrees"
            )
            set_joint_angles(home, [1.2, 0.4, np.pi / 4, 0.0])
            assert "45 of 45 degrees: matches the file" in read_output_line(process)
            assert process.wait(20) == 0
        set_joint_angles(home, [0.0] * JOINT_COUNT)
        wait_for_published_angle(home, endpoint, ZERO_RAD[0])
        assert (
            snakesim(
                "robot",
                "calibrate",
                "zero",
                "snake.toml",
                "--now",
                "--endpoint",
                endpoint,
                cwd=home,
            ).code
            == 0
        )
    found = read_robot_file(home).joint_table
    assert [joint.drive.sign for joint in found] == SIGN.tolist()
    assert [joint.drive.zero_rad for joint in found] == pytest.approx(ZERO_RAD.tolist(), abs=1e-3)
    ends = found[0].limits
    assert (ends.lower_rad, ends.upper_rad) == pytest.approx(
        (-0.9 + 0.3 + 0.02, 1.2 + 0.3 - 0.02), abs=1e-3
    )
    text = (home / "snake.toml").read_text()
    assert "# paper, section IV-A" in text
    assert "sign = -1 # turned by hand, " in text


def swapped(home: Path, endpoint: str) -> str:
    """Turn joint_2 when joint_1 is asked for."""
    with calibrating(home, endpoint, "direction", "snake.toml", "joint_1") as process:
        read_output_line(process)
        set_joint_angles(home, [1.2, 0.4, 0.0, 0.0])
        said = read_output_line(process)
        assert process.wait(20) == 1
    return said


def test_by_hand_refuses_armed_robot_shipped_file_and_unknown_joint(home: Path) -> None:
    set_joint_angles(home, [0.0] * JOINT_COUNT)
    before = (home / "snake.toml").read_bytes()
    with running_snakesim(
        home / "run", "bench.toml", "--backend", "./held.py:Held", "--duration", "600"
    ) as run:
        run.wait_for(" of 600 s")  # armed
        for words, code, why in (
            (("zero", "snake.toml", "--now"), 1, "snakesim robot disarm"),
            (("zero", "planar13", "--now"), 2, "your own robot file"),
            (("limits", "snake.toml", "joint_9"), 2, "joint_1 to joint_4"),
        ):
            refused = run.run_tool("robot", "calibrate", *words)
            assert refused.code == code and why in refused.err, refused.printed
    assert (home / "snake.toml").read_bytes() == before
