"""`snakesim robot jog` on a robot that nobody checked, from a terminal whose key is held, let go, or lost."""

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

REPEAT_S = 0.03  # of a key
HELD_BACK = 270  # keys that come at once, as after a stall of some seconds
UP = b"\x1b[A"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return make_jogged_folder(tmp_path)


@contextmanager
def jogging(home: Path, endpoint: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The command, once it is armed, and the other end of its terminal."""
    (ours, theirs), words = (
        pty.openpty(),
        ("robot", "jog", "snake.toml", "joint_2", "--endpoint", endpoint),
    )
    try:
        with run_in_background(home, *words, stdin=theirs) as process:
            assert process.stdout is not None
            process.stdout.readline()  # "joint_2: from ...", once it is armed
            yield process, ours
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.quiet
def test_it_moves_while_the_key_repeats_and_only_that_joint(home: Path) -> None:
    with running_bench_host(home, BACKEND) as endpoint:
        assert moved_and_stood(home, endpoint)
        wait_until(lambda: read_setpoints(home)["lifecycle"] == "disarmed", "the end of it")
        assert stopped_when_killed(home, endpoint)


def moved_and_stood(home: Path, endpoint: str) -> bool:
    """Hold the key, let it go, quit; False when the robot was not armed, or stopped meanwhile."""
    with jogging(home, endpoint) as (process, terminal):

        def ended() -> bool:
            return process.poll() is not None or is_at_fault(home)

        wait_until(
            lambda: ended() or read_setpoints(home)["mode"] == [0, 1, 0, 0],
            "one joint with current",
        )
        before = read_setpoints(home)["target"][1]
        while not ended() and read_setpoints(home)["target"][1] < before + 0.04:
            os.write(terminal, UP)
            time.sleep(REPEAT_S)
        let_go = read_setpoints(home)["tick"]
        wait_until(lambda: read_setpoints(home)["tick"] > let_go + 25, "half a second")
        half = read_setpoints(home)
        wait_until(lambda: read_setpoints(home)["tick"] > let_go + 50, "another half second")
        if ended():
            return False
        assert half["limit_nm"][1] == pytest.approx(0.3 * 7.0)
        assert read_setpoints(home)["target"][1] == half["target"][1]
        os.write(terminal, HELD_BACK * UP)
        held_back = read_setpoints(home)["tick"]
        wait_until(lambda: read_setpoints(home)["tick"] > held_back + 25, "half a second")
        if ended():
            return False
        assert read_setpoints(home)["target"][1] == half["target"][1], (
            "moved by keys that a network has held back"
        )
        os.write(terminal, b"q")
        return process.wait(20) == 0


def stopped_when_killed(home: Path, endpoint: str) -> bool:
    """Kill the command; False when it was not armed."""
    with jogging(home, endpoint) as (process, _terminal):
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
