"""Dynamixel servos, emulated by another program behind a pseudo terminal, are driven in real time."""

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

# A sync write of 1 to the register `torque enable` (64): instruction, address, size, and each servo with its value.
ENABLE_PACKET = re.compile(
    r" out .* 83 40 00 01 00( [0-9a-f]{2} 01)+ [0-9a-f]{2} [0-9a-f]{2}$", re.MULTILINE
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide the folder of all programs."""
    return tmp_path_factory.mktemp("servos")


@pytest.fixture(scope="module")
def pose_address(folder: Path) -> Iterator[str]:
    """Emulate servos on `./servos`; provide the address to which they send the pose."""
    address = f"127.0.0.1:{find_free_port()}"
    output = folder / "servos.log"
    # Real servos do not wait for a busy computer.
    priority = REAL_TIME_PRIORITY if os.geteuid() == 0 else ()
    with output.open("wb") as file:
        servos = subprocess.Popen(
            [
                *priority,
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
        wait_until(lambda: "servos ready: 13" in output.read_text(), "the servos are ready")
        yield address
    finally:
        servos.terminate()
        servos.wait(10)
    assert not (folder / "servos").is_symlink(), "the channel still exists"


def run_hold(folder: Path, pose_address: str, *arguments: str) -> CompletedRun:
    """Run a scenario that holds its pose, at a low rate."""
    connection = (
        "--set",
        'backend.ports=["servos"]',
        "--set",
        f'backend.pose_listen="{pose_address}"',
    )
    timing = ("--set", "rate_hz=25", "--set", "backend.watchdog_s=0.5", "--clock-mode", "realtime")
    robot = ("triplet", "--backend", "dynamixel", "--controller", "hold")
    network = ("--endpoint", find_free_endpoint())
    return snakesim("run", *robot, *connection, *timing, *network, *arguments, cwd=folder)


def test_external_servos_are_detected_and_driven_in_realtime(
    pose_address: str, folder: Path
) -> None:
    scan = snakesim("drive", "scan", "dynamixel", "servos", "--baud", "1000000", cwd=folder)
    assert scan.code == 0, scan.printed
    assert scan.out.count("XM540-W270 (1120)") == 13, scan.printed
    result = run_hold(folder, pose_address, "--duration", "2")
    assert result.code == 0, result.printed
    second_scan = snakesim("drive", "scan", "dynamixel", "servos", "--baud", "1000000", cwd=folder)
    operating_modes = {line.split()[6] for line in second_scan.out.splitlines()[1:]}
    assert operating_modes == {"5"}, "the mode is not current-based position"


def test_servos_that_stop_while_host_is_frozen_stay_off(pose_address: str, folder: Path) -> None:
    """The host's process gets SIGSTOP for 1 s; the clause for every drive type is in the contract suite."""
    options = (
        *("--fault", "freeze:host@0.5-1.5", "--duration", "5"),
        *("--set", "backend.log=bytes.log"),
    )
    result = run_hold(folder, pose_address, *options, "--out", str(folder / "frozen"))
    record = RunRecord.load(folder / "frozen").host
    assert record.armed_ticks > 10, "the robot was not armed before the freeze"
    assert result.code == 1, result.printed
    assert record.lifecycle == "fault", result.printed
    stopped_joints = {
        fault.joint
        for fault in record.faults
        if fault.what == "drive_fault" and "watchdog" in fault.cause
    }
    assert len(stopped_joints) == 13, record.faults
    # The servos were enabled only once, when the robot was armed.
    enable_packets = ENABLE_PACKET.findall((folder / "bytes.log").read_text())
    assert len(enable_packets) == 1


def test_host_and_service_of_one_scenario_arm_external_servos(tmp_path: Path) -> None:
    """Servos have no velocity mode, which the robot file lists: the host leaves it out, and the service does not."""
    write_servo_row(tmp_path, "dynamixel", "row")
    network = ("--endpoint", find_free_endpoint())

    def start(stack: contextlib.ExitStack, log: str, *arguments: str) -> Path:
        """Start a program and return the file with its output."""
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
        wait_until(lambda: "servos ready: 4" in servos.read_text(), "the servos are ready")
        start(stack, "host.log", "start", "host", "row.toml", "--backend", "dynamixel", *network)
        with contextlib.ExitStack() as other_stack:
            start(
                other_stack,
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
        wait_until(lambda: arm().code == 0, "the robot is armed", 60.0)
