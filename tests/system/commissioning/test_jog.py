"""`snakesim robot jog` moves one joint of an unchecked robot while a key is held, and stops it with the terminal."""

import os
import pty
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.bench_host import running_bench_host
from snakesim_testing.runs.command import run_in_background
from snakesim_testing.runs.jogged_robot import (
    BACKEND,
    is_at_fault,
    make_jogged_folder,
    read_setpoints,
)

REPEAT_S = 0.03  # between repetitions of a held key
DELAYED_KEY_COUNT = 270  # keys that arrive at once after the network stalled for some seconds
UP_KEY = b"\x1b[A"
HALF_SECOND_TICKS = 25
MIN_MOTION_RAD = 0.04
MAX_TORQUE_NM = 7.0  # of the robot file; a jog may use 30 % of it


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Make a folder with a robot whose setpoints are written into a file."""
    return make_jogged_folder(tmp_path)


@contextmanager
def running_jog(home: Path, endpoint: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Run the jog command, and yield it with the test's end of its terminal after the robot is armed."""
    test_end, command_end = pty.openpty()
    arguments = ("robot", "jog", "snake.toml", "joint_2", "--endpoint", endpoint)
    try:
        with run_in_background(home, *arguments, stdin=command_end) as process:
            assert process.stdout is not None
            process.stdout.readline()  # "joint_2: from ..." is printed when the robot is armed.
            yield process, test_end
    finally:
        os.close(test_end)
        os.close(command_end)


@pytest.mark.quiet
def test_jog_moves_only_its_joint_while_key_is_held(home: Path) -> None:
    with running_bench_host(home, BACKEND) as endpoint:
        assert jog_and_release_key(home, endpoint)
        wait_until(lambda: read_setpoints(home)["lifecycle"] == "disarmed", "a disarmed robot")
        assert kill_jog_command(home, endpoint)


def jog_and_release_key(home: Path, endpoint: str) -> bool:
    """Hold the key, release it, and quit.

    The joint must move while the key is held and remain at rest afterwards, also if delayed keys arrive.

    Returns:
        False if the robot was not armed, or if a fault stopped it.
    """
    with running_jog(home, endpoint) as (process, terminal):

        def has_ended() -> bool:
            return process.poll() is not None or is_at_fault(home)

        wait_until(
            lambda: has_ended() or read_setpoints(home)["mode"] == [0, 1, 0, 0],
            "one joint with current",
        )
        initial_rad = read_setpoints(home)["target"][1]
        while not has_ended() and read_setpoints(home)["target"][1] < initial_rad + MIN_MOTION_RAD:
            os.write(terminal, UP_KEY)
            time.sleep(REPEAT_S)
        release_tick = read_setpoints(home)["tick"]
        wait_until(
            lambda: read_setpoints(home)["tick"] > release_tick + HALF_SECOND_TICKS, "half a second"
        )
        released = read_setpoints(home)
        wait_until(
            lambda: read_setpoints(home)["tick"] > release_tick + 2 * HALF_SECOND_TICKS,
            "another half second",
        )
        if has_ended():
            return False
        assert released["limit_nm"][1] == pytest.approx(0.3 * MAX_TORQUE_NM)
        assert read_setpoints(home)["target"][1] == released["target"][1]
        os.write(terminal, DELAYED_KEY_COUNT * UP_KEY)
        delayed_tick = read_setpoints(home)["tick"]
        wait_until(
            lambda: read_setpoints(home)["tick"] > delayed_tick + HALF_SECOND_TICKS, "half a second"
        )
        if has_ended():
            return False
        assert read_setpoints(home)["target"][1] == released["target"][1], (
            "delayed keys moved the joint"
        )
        os.write(terminal, b"q")
        return process.wait(20) == 0


def kill_jog_command(home: Path, endpoint: str) -> bool:
    """Kill the command, and wait for the stop. Return False if the robot was not armed."""
    with running_jog(home, endpoint) as (process, _terminal):
        wait_until(
            lambda: process.poll() is not None or read_setpoints(home)["lifecycle"] != "disarmed",
            "armed again",
        )
        if process.poll() is not None:
            return False
        process.kill()
        wait_until(
            lambda: read_setpoints(home)["lifecycle"] == "fault",
            "a stop after the terminal is lost",
        )
        return True
