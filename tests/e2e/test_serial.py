"""Servos of another program: two processes and a pseudo terminal between them, in real time."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.command import SNAKESIM, environment, snakesim
from tests.harness.endpoint import free_endpoint
from tests.harness.wait import wait_until
from tests.machines import HURRIED

pytestmark = pytest.mark.e2e


@pytest.fixture
def pose(tmp_path: Path) -> Iterator[str]:
    """Servos on `./servos`; where they send the pose."""
    address = f"127.0.0.1:{free_endpoint().rpartition(':')[2]}"
    said, first = tmp_path / "servos.said", HURRIED if os.geteuid() == 0 else ()  # real servos wait for nobody
    with said.open("wb") as file:
        servos = subprocess.Popen(
            [*first, *SNAKESIM, "dynamixels", "triplet", "--link", "servos", "--pose", address],
            cwd=tmp_path,
            env=environment(tmp_path),
            stdout=file,
            stderr=file,
        )
    try:
        wait_until(lambda: "servos ready: 13" in said.read_text(), "the servos")
        yield address
    finally:
        servos.terminate()
        servos.wait(10)
    assert not (tmp_path / "servos").is_symlink(), "its name is taken away"


def test_servos_of_another_program_are_found_and_driven_in_real_time(pose: str, tmp_path: Path) -> None:
    found = snakesim("serial", "scan", "servos", "--baud", "1000000", cwd=tmp_path)
    assert found.code == 0 and found.out.count("XM540-W270 (1120)") == 13, found.said
    where = ("--set", 'backend.ports=["servos"]', "--set", f'backend.pose_listen="{pose}"')
    slow = ("--set", "rate_hz=25", "--set", "backend.watchdog_s=0.5", "--pace", "realtime", "--duration", "2")
    hold = ("run", "triplet", "--backend", "dynamixel", "--controller", "hold", *where, *slow)
    ended = [snakesim(*hold, "--endpoint", free_endpoint(), cwd=tmp_path)]
    while ended[-1].code and len(ended) < 5:  # a computer that stutters stops a robot now and then
        ended.append(snakesim(*hold, "--endpoint", free_endpoint(), cwd=tmp_path))
    assert ended[-1].code == 0, ended[-1].said
    again = snakesim("serial", "scan", "servos", "--baud", "1000000", cwd=tmp_path)
    assert {line.split()[6] for line in again.out.splitlines()[1:]} == {"5"}, "current-based position is kept"
