"""Feetech servos of another program: they have no watchdog, and hold when their host is killed."""

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

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

UNGUARDED = "no joint has a watchdog: it holds its last angle if the host dies"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where everything runs, with servos on `./servos`."""
    folder = tmp_path_factory.mktemp("servos")
    write_servo_row(folder, "feetech", "servos")
    first = (
        REAL_TIME_PRIORITY if os.geteuid() == 0 else ()
    )  # real servos do not wait for a busy computer
    printed = folder / "servos.log"
    with printed.open("wb") as file:
        servos = subprocess.Popen(
            [
                *first,
                *SNAKESIM_COMMAND,
                "drive",
                "emulate",
                "feetech",
                "row.toml",
                "--channel",
                "servos",
            ],
            cwd=folder,
            env=make_environment(folder),
            stdout=file,
            stderr=file,
        )
    try:
        wait_until(lambda: "servos ready: 4" in printed.read_text(), "the servos")
        yield folder
    finally:
        servos.terminate()
        servos.wait(10)
    assert not (folder / "servos").is_symlink(), "its name is taken away"


def scan_torques(folder: Path) -> list[str]:
    """Return whether the torque of each servo is on, as the scan prints it."""
    found = snakesim("drive", "scan", "feetech", "servos", "--baud", "1000000", cwd=folder)
    assert found.code == 0 and found.out.count("STS3215 (777)") == 4, found.printed
    return re.findall(r" rad +(on|off) ", found.out)


def run(folder: Path, *arguments: str) -> CompletedRun:
    """Run the scenario, which holds its pose."""
    return snakesim(
        "run",
        "row.toml",
        "--backend",
        "feetech",
        "--endpoint",
        find_free_endpoint(),
        *arguments,
        cwd=folder,
    )


def test_external_servos_are_detected_and_driven_and_off_afterwards(folder: Path) -> None:
    assert scan_torques(folder) == ["off"] * 4
    ended = run(folder, "--duration", "2")
    assert ended.code == 0, ended.printed
    assert UNGUARDED in ended.printed
    assert scan_torques(folder) == ["off"] * 4


def test_servos_hold_while_host_is_frozen_and_are_off_once_it_resumes(folder: Path) -> None:
    """The host's process gets SIGSTOP for 1.5 s, three times its longest pause."""
    ended = run(
        folder, "--fault", "freeze:host@0.5-2", "--duration", "5", "--out", str(folder / "frozen")
    )
    record = RunRecord.load(folder / "frozen").host
    assert record.armed_ticks > 5, "it was armed when it was frozen"
    assert ended.code == 1 and record.lifecycle == "fault", ended.printed
    alone = {fault.joint for fault in record.faults if "held its last angle" in fault.cause}
    assert len(alone) == 4, record.faults
    assert scan_torques(folder) == ["off"] * 4


def test_servos_keep_their_torque_when_host_is_killed_and_the_next_start_switches_it_off(
    folder: Path,
) -> None:
    endpoint = find_free_endpoint()
    printed = folder / "host.log"
    programs: list[subprocess.Popen[bytes]] = []

    def start(log: Path, *arguments: str) -> subprocess.Popen[bytes]:
        with log.open("wb") as file:
            program = subprocess.Popen(
                [*SNAKESIM_COMMAND, *arguments, "--endpoint", endpoint],
                cwd=folder,
                env=make_environment(folder),
                stdout=file,
                stderr=file,
            )
        programs.append(program)
        return program

    try:
        host = start(printed, "start", "host", "row.toml", "--backend", "feetech")
        start(folder / "control.log", "start", "service", "control", "row.toml")
        network = ("--endpoint", endpoint)
        wait_until(
            lambda: snakesim("robot", "arm", "row", "feetech", *network, cwd=folder).code == 0,
            "the robot is armed",
            60.0,
        )
        status = snakesim("status", *network, cwd=folder)
        assert UNGUARDED in status.out, status.printed
        host.send_signal(signal.SIGKILL)
        host.wait(10)
        assert scan_torques(folder) == ["on"] * 4, "this is what a missing watchdog means"
    finally:
        for program in programs:
            program.terminate()
            program.wait(10)
    assert run(folder, "--duration", "1").code == 0
    assert scan_torques(folder) == ["off"] * 4
