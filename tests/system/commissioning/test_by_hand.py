"""`snakesim robot calibrate zero|direction|gear|limits` measures a robot whose joints the test turns by hand."""

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

# How the drives are really mounted. The robot file does not contain it yet.
SIGN = np.array([1.0, -1.0, 1.0, 1.0])
ZERO_RAD = np.array([0.3, -0.2, 0.0, 0.1])
LIMIT_MARGIN_RAD = 0.02  # distance of a calibrated limit from the measured end


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Make a folder with a robot that is turned by hand."""
    return make_hand_turned_folder(tmp_path)


def set_joint_angles(home: Path, joints_rad: Sequence[float]) -> None:
    """Turn the joints to angles. The drives measure them as they are mounted."""
    drive_angles_rad = ZERO_RAD + SIGN * np.array(joints_rad)
    (home / "new.json").write_text(json.dumps(drive_angles_rad.tolist()))
    (home / "new.json").replace(home / "drives.json")


def running_calibration(
    home: Path, endpoint: str, *arguments: str
) -> AbstractContextManager[subprocess.Popen[str]]:
    """Run a calibration command, which the test answers by turning joints and pressing Enter."""
    return run_in_background(
        home, "robot", "calibrate", *arguments, "--endpoint", endpoint, stdin=subprocess.PIPE
    )


def read_output_line(process: subprocess.Popen[str]) -> str:
    """Return the next line that the command prints."""
    assert process.stdout is not None
    return process.stdout.readline()


def press_enter(process: subprocess.Popen[str]) -> str:
    """Press Enter, and return what the command prints until it ends."""
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return process.communicate(timeout=30)[0]


@pytest.mark.heavy
def test_calibration_by_hand_writes_mounting_and_limits_to_robot_file(home: Path) -> None:
    pose_rad = [0.0] * JOINT_COUNT
    set_joint_angles(home, pose_rad)
    with running_bench_host(home, BACKEND) as endpoint:
        with running_calibration(home, endpoint, "direction", "snake.toml") as process:
            for joint in range(JOINT_COUNT):
                assert read_output_line(process).startswith(
                    f"joint_{joint + 1}: turn the link in front of it to the left"
                )
                pose_rad[joint] += 0.3
                set_joint_angles(home, pose_rad)
                result = "the other way round" if SIGN[joint] < 0 else "matches the file"
                assert result in read_output_line(process)
            assert "1 joints changed" in read_output_line(process)
            assert process.wait(20) == 0
        refused = snakesim(
            "robot", "calibrate", "zero", "snake.toml", "--now", "--endpoint", endpoint, cwd=home
        )
        assert refused.code == 2
        assert "restart the host with this file" in refused.err
    set_joint_angles(home, [0.0] * JOINT_COUNT)
    with running_bench_host(home, BACKEND) as endpoint:
        with running_calibration(home, endpoint, "limits", "snake.toml", "joint_1") as process:
            assert read_output_line(process).startswith("Move each joint")
            for angle_rad in (-0.9, 1.2):
                set_joint_angles(home, [angle_rad, 0.0, 0.0, 0.0])
                wait_for_published_angle(home, endpoint, angle_rad + ZERO_RAD[0])
            assert "1 joints changed" in press_enter(process)
        assert "joint_2 reports the turn" in turn_wrong_joint(home, endpoint)
        with running_calibration(
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
        completed = snakesim(
            "robot", "calibrate", "zero", "snake.toml", "--now", "--endpoint", endpoint, cwd=home
        )
        assert completed.code == 0
    joints = read_robot_file(home).joint_table
    assert [joint.drive.sign for joint in joints] == SIGN.tolist()
    assert [joint.drive.zero_rad for joint in joints] == pytest.approx(ZERO_RAD.tolist(), abs=1e-3)
    # The limits were measured before the zero of 0.3 rad was set.
    limits = joints[0].limits
    assert (limits.lower_rad, limits.upper_rad) == pytest.approx(
        (-0.9 + 0.3 + LIMIT_MARGIN_RAD, 1.2 + 0.3 - LIMIT_MARGIN_RAD), abs=1e-3
    )
    text = (home / "snake.toml").read_text()
    assert "# paper, section IV-A" in text
    assert "sign = -1 # turned by hand, " in text


def turn_wrong_joint(home: Path, endpoint: str) -> str:
    """Turn joint_2 although the command requests joint_1, and return what it prints."""
    with running_calibration(home, endpoint, "direction", "snake.toml", "joint_1") as process:
        read_output_line(process)
        set_joint_angles(home, [1.2, 0.4, 0.0, 0.0])
        result = read_output_line(process)
        assert process.wait(20) == 1
    return result


@pytest.mark.heavy
def test_calibration_refuses_armed_robot_shipped_file_and_unknown_joint(home: Path) -> None:
    set_joint_angles(home, [0.0] * JOINT_COUNT)
    content_before = (home / "snake.toml").read_bytes()
    with running_snakesim(
        home / "run", "bench.toml", "--backend", "./held.py:Held", "--duration", "600"
    ) as run:
        run.wait_for(" of 600 s")  # The robot is armed.
        for arguments, expected_code, expected_text in (
            (("zero", "snake.toml", "--now"), 1, "snakesim robot disarm"),
            (("zero", "planar13", "--now"), 2, "your own robot file"),
            (("limits", "snake.toml", "joint_9"), 2, "joint_1 to joint_4"),
        ):
            refused = run.run_tool("robot", "calibrate", *arguments)
            assert refused.code == expected_code, refused.printed
            assert expected_text in refused.err, refused.printed
    assert (home / "snake.toml").read_bytes() == content_before
