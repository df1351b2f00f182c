"""`snakesim robot jog` on a robot that nobody checked, from a terminal whose key is held, let go, or lost."""

import json
import os
import pty
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.contract.workbench import text_of_the_example
from tests.e2e.bench import host, lab_folder
from tests.e2e.command import background
from tests.e2e.test_by_hand import JOINTS, SCENARIO
from tests.harness.wait import wait_until
from tests.whole.command import snakesim

REPEAT_S = 0.03  # of a key
TRIES = 4
HELD_BACK = 270  # keys that come at once, as after a stall of some seconds
BACKEND = "./told.py:Told"
UP = b"\x1b[A"
TOLD = """

import json
from pathlib import Path


class Told(Workbench):
    \"\"\"What it is told stands in a file.\"\"\"

    ticks = 0

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        self.ticks += 1
        told = {"tick": self.ticks, "lifecycle": lifecycle, "mode": setpoints.mode, "target": setpoints.target}
        Path("new.json").write_text(json.dumps({**told, "limit_nm": setpoints.torque_limit_nm}))
        Path("new.json").replace("told.json")
"""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    real = text_of_the_example().replace("emulated=True", "emulated=False")
    return lab_folder(tmp_path, JOINTS, SCENARIO, {"told.py": real + TOLD})


@contextmanager
def jogging(home: Path, endpoint: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The command, once it is armed, and the other end of its terminal."""
    (ours, theirs), words = pty.openpty(), ("robot", "jog", "snake.toml", "joint_2", "--endpoint", endpoint)
    try:
        with background(home, *words, stdin=theirs) as process:
            assert process.stdout is not None
            process.stdout.readline()  # "joint_2: from ...", once it is armed
            yield process, ours
    finally:
        os.close(ours)
        os.close(theirs)


def told(home: Path) -> dict[str, Any]:
    return json.loads((home / "told.json").read_text())


def test_it_moves_while_the_key_repeats_and_only_that_joint(home: Path) -> None:
    with host(home, BACKEND) as endpoint:
        steadily(home, endpoint, moved_and_stood)
        wait_until(lambda: told(home)["lifecycle"] == "disarmed", "the end of it")
        steadily(home, endpoint, stopped_when_killed)


def steadily(home: Path, endpoint: str, tried: Callable[[Path, str], bool]) -> None:
    """Until it was done; a computer that was busy for longer than a lease may stop or refuse it."""
    for _ in range(TRIES):
        if tried(home, endpoint):
            return
        why = snakesim("status", "--endpoint", endpoint, cwd=home).out
        assert "lease" in why, why
        snakesim("robot", "reset", "--endpoint", endpoint, cwd=home)
    pytest.fail("a busy computer")


def moved_and_stood(home: Path, endpoint: str) -> bool:
    """Hold the key, let it go, quit; False when the robot was not armed, or stopped meanwhile."""
    with jogging(home, endpoint) as (process, terminal):

        def ended() -> bool:
            return process.poll() is not None or stopped(home)

        wait_until(lambda: ended() or told(home)["mode"] == [0, 1, 0, 0], "one joint with current")
        before = told(home)["target"][1]
        while not ended() and told(home)["target"][1] < before + 0.04:
            os.write(terminal, UP)
            time.sleep(REPEAT_S)
        let_go = told(home)["tick"]
        wait_until(lambda: told(home)["tick"] > let_go + 25, "half a second")
        half = told(home)
        wait_until(lambda: told(home)["tick"] > let_go + 50, "another half second")
        if ended():
            return False
        assert half["limit_nm"][1] == pytest.approx(0.3 * 7.0)
        assert told(home)["target"][1] == half["target"][1]
        os.write(terminal, HELD_BACK * UP)
        held_back = told(home)["tick"]
        wait_until(lambda: told(home)["tick"] > held_back + 25, "half a second")
        if ended():
            return False
        assert told(home)["target"][1] == half["target"][1], "moved by keys that a network has held back"
        os.write(terminal, b"q")
        return process.wait(20) == 0


def stopped_when_killed(home: Path, endpoint: str) -> bool:
    """Kill the command; False when it was not armed."""
    with jogging(home, endpoint) as (process, _terminal):
        wait_until(lambda: process.poll() is not None or told(home)["lifecycle"] != "disarmed", "armed again")
        if process.poll() is not None:
            return False
        process.kill()
        wait_until(lambda: told(home)["lifecycle"] == "fault", "a stop after the terminal is lost")
        return True


def stopped(home: Path) -> bool:
    return told(home)["lifecycle"] == "fault"
