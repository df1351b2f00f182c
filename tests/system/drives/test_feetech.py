"""Feetech servos, emulated by another program, have no watchdog and hold their angle if their host is killed."""

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

NO_WATCHDOG_WARNING = "no joint has a watchdog: it holds its last angle if the host dies"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Provide the folder of all programs, with emulated servos on `./servos`."""
    folder = tmp_path_factory.mktemp("servos")
    write_servo_row(folder, "feetech", "servos")
    # Real servos do not wait for a busy computer.
    priority = REAL_TIME_PRIORITY if os.geteuid() == 0 else ()
    printed = folder / "servos.log"
    with printed.open("wb") as file:
        servos = subprocess.Popen(
            [
                *priority,
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
        wait_until(lambda: "servos ready: 4" in printed.read_text(), "the servos are ready")
        yield folder
    finally:
        servos.terminate()
        servos.wait(10)
    assert not (folder / "servos").is_symlink(), "the channel still exists"


def scan_torques(folder: Path) -> list[str]:
    """Return whether the torque of each servo is on, as the scan prints it."""
    scan = snakesim("drive", "scan", "feetech", "servos", "--baud", "1000000", cwd=folder)
    assert scan.code == 0, scan.printed
    assert scan.out.count("STS3215 (777)") == 4, scan.printed
    return re.findall(r" rad +(on|off) ", scan.out)


def run_scenario(folder: Path, *arguments: str) -> CompletedRun:
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


def test_feetech_servos_are_detected_driven_and_disabled_afterwards(folder: Path) -> None:
    assert scan_torques(folder) == ["off"] * 4
    result = run_scenario(folder, "--duration", "2")
    assert result.code == 0, result.printed
    assert NO_WATCHDOG_WARNING in result.printed
    assert scan_torques(folder) == ["off"] * 4


def test_feetech_servos_hold_while_host_is_frozen(folder: Path) -> None:
    """The host's process gets SIGSTOP for 1.5 s, three times its longest pause."""
    result = run_scenario(
        folder, "--fault", "freeze:host@0.5-2", "--duration", "5", "--out", str(folder / "frozen")
    )
    record = RunRecord.load(folder / "frozen").host
    assert record.armed_ticks > 5, "the robot was not armed before the freeze"
    assert result.code == 1, result.printed
    assert record.lifecycle == "fault", result.printed
    holding_joints = {
        fault.joint for fault in record.faults if "held its last angle" in fault.cause
    }
    assert len(holding_joints) == 4, record.faults
    assert scan_torques(folder) == ["off"] * 4


def test_feetech_servos_of_killed_host_hold_until_next_start(
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
        assert NO_WATCHDOG_WARNING in status.out, status.printed
        host.send_signal(signal.SIGKILL)
        host.wait(10)
        # Nothing disables servos without a watchdog.
        assert scan_torques(folder) == ["on"] * 4
    finally:
        for program in programs:
            program.terminate()
            program.wait(10)
    assert run_scenario(folder, "--duration", "1").code == 0
    assert scan_torques(folder) == ["off"] * 4
