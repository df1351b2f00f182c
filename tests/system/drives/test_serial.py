"""Servos of another program: two processes and a pseudo terminal between them, in real time."""

import contextlib
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_hal.network.free_ports import find_free_port
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.harness.command import (
    SNAKESIM_COMMAND,
    CompletedRun,
    make_environment,
    snakesim,
)
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.lab.machines import REAL_TIME_PRIORITY
from snakesim_testing.runs.servo_row import write_servo_row

pytestmark = [pytest.mark.e2e, pytest.mark.quiet]

# A sync write of 1 to the register `torque enable` (64): instruction, address, size, and servos with what they get.
ENABLES = re.compile(
    r" out .* 83 40 00 01 00( [0-9a-f]{2} 01)+ [0-9a-f]{2} [0-9a-f]{2}$", re.MULTILINE
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where everything runs."""
    return tmp_path_factory.mktemp("servos")


@pytest.fixture(scope="module")
def pose(folder: Path) -> Iterator[str]:
    """Servos on `./servos`; where they send the pose."""
    address = f"127.0.0.1:{find_free_port()}"
    # Real servos wait for nobody.
    output, first = folder / "servos.log", REAL_TIME_PRIORITY if os.geteuid() == 0 else ()
    with output.open("wb") as file:
        servos = subprocess.Popen(
            [
                *first,
                *SNAKESIM_COMMAND,
                "drive",
                "emulate",
                "dynamixel",
                "triplet",
                "--channel",
                "servos",
                "--pose",
                address,
            ],
            cwd=folder,
            env=make_environment(folder),
            stdout=file,
            stderr=file,
        )
    try:
        wait_until(lambda: "servos ready: 13" in output.read_text(), "the servos")
        yield address
    finally:
        servos.terminate()
        servos.wait(10)
    assert not (folder / "servos").is_symlink(), "its name is taken away"


def run(folder: Path, pose: str, *arguments: str) -> CompletedRun:
    """A run that holds its pose."""
    where = ("--set", 'backend.ports=["servos"]', "--set", f'backend.pose_listen="{pose}"')
    slow = ("--set", "rate_hz=25", "--set", "backend.watchdog_s=0.5", "--clock-mode", "realtime")
    hold = ("run", "triplet", "--backend", "dynamixel", "--controller", "hold", *where, *slow)
    return snakesim(*hold, "--endpoint", find_free_endpoint(), *arguments, cwd=folder)


def test_external_servos_are_detected_and_driven_in_real_time(pose: str, folder: Path) -> None:
    found = snakesim("drive", "scan", "dynamixel", "servos", "--baud", "1000000", cwd=folder)
    assert found.code == 0 and found.out.count("XM540-W270 (1120)") == 13, found.printed
    ended = run(folder, pose, "--duration", "2")
    assert ended.code == 0, ended.printed
    again = snakesim("drive", "scan", "dynamixel", "servos", "--baud", "1000000", cwd=folder)
    assert {line.split()[6] for line in again.out.splitlines()[1:]} == {"5"}, (
        "current-based position is kept"
    )


def test_servos_that_stop_while_host_is_frozen_stay_off(pose: str, folder: Path) -> None:
    """The host's process gets SIGSTOP for 1 s; the clause for every drive type is in the contract suite."""
    frozen = ("--fault", "freeze:host@0.5-1.5", "--duration", "5", "--set", "backend.log=bytes.log")
    ended = run(folder, pose, *frozen, "--out", str(folder / "frozen"))
    record = RunRecord.load(folder / "frozen").host
    assert record.armed_ticks > 10, "it was armed when it was frozen"
    assert ended.code == 1 and record.lifecycle == "fault", ended.printed
    stopped = {
        fault.joint
        for fault in record.faults
        if fault.what == "drive_fault" and "watchdog" in fault.cause
    }
    assert len(stopped) == 13, record.faults
    assert len(ENABLES.findall((folder / "bytes.log").read_text())) == 1, (
        "enabled once, by the arming"
    )


def test_a_host_and_a_service_of_one_scenario_arm_servos_of_another_program(tmp_path: Path) -> None:
    """Servos have no velocity mode, which the robot file lists: the host leaves it out, and the service does not."""
    write_servo_row(tmp_path, "dynamixel", "row")
    network = ("--endpoint", find_free_endpoint())

    def start(stack: contextlib.ExitStack, log: str, *arguments: str) -> Path:
        """Start a program; returns the file with its output."""
        path = tmp_path / log
        file = stack.enter_context(path.open("wb"))
        program = subprocess.Popen(
            [*SNAKESIM_COMMAND, *arguments],
            cwd=tmp_path,
            env=make_environment(tmp_path),
            stdout=file,
            stderr=file,
        )
        stack.callback(program.wait, 10)
        stack.callback(program.terminate)
        return path

    def arm() -> CompletedRun:
        return snakesim("robot", "arm", "row", "dynamixel", *network, cwd=tmp_path)

    with contextlib.ExitStack() as stack:
        servos = start(
            stack, "servos.log", "drive", "emulate", "dynamixel", "row.toml", "--channel", "row"
        )
        wait_until(lambda: "servos ready: 4" in servos.read_text(), "the servos")
        start(stack, "host.log", "start", "host", "row.toml", "--backend", "dynamixel", *network)
        with contextlib.ExitStack() as other:
            start(
                other,
                "other.log",
                "start",
                "service",
                "control",
                "row.toml",
                "--set",
                "mission.speed_m_s=0.3",
                *network,
            )
            wait_until(
                lambda: "`mission.speed_m_s` = 0.3 (here " in arm().printed, "a refusal", 30.0
            )
        start(stack, "control.log", "start", "service", "control", "row.toml", *network)
        wait_until(lambda: arm().code == 0, "armed", 60.0)
