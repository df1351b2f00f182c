"""A bus of python-can connects two processes by UDP multicast, on the loopback of a separate network namespace.

Emulated drives have priority over other processes, because real ones do not wait for a busy computer.
"""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from snakesim_testing.harness.bad_plugins import BAD
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.lab.machines import NamespaceMachine

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(os.geteuid() != 0, reason="makes a network namespace: needs root"),
]
pytest.importorskip("msgpack", reason="python-can's UDP bus needs it")

CHANNEL = "udp_multicast:239.74.163.2"
POSE_ADDRESS = "127.0.0.1:7450"
LISTEN_TO_POSE = ("--set", f'backend.pose_listen="{POSE_ADDRESS}"')
SNAKESIM = str(Path(sys.executable).with_name("snakesim"))


@pytest.fixture
def machine() -> Iterator[NamespaceMachine]:
    """Provide a network namespace whose loopback interface supports multicast."""
    with ExitStack() as stack:
        machine = NamespaceMachine(stack)
        machine.run("ip", "link", "set", "lo", "multicast", "on")
        machine.run("ip", "route", "add", "239.0.0.0/8", "dev", "lo")
        yield machine


@contextmanager
def running_emulated_drives(
    machine: NamespaceMachine, folder: Path, drive_name: str, driver_type: str, *options: str
) -> Iterator[None]:
    """Emulate drives on the bus in another process. It prints `drive_name` when they are ready."""
    log = folder / "drives.log"
    arguments = ("drive", "emulate", driver_type, "triplet", "--channel", CHANNEL, *options)
    process = machine.start(SNAKESIM, *arguments, log=log, hurried=True)
    try:
        wait_until(
            lambda: f"{drive_name} ready: 13" in log.read_text(), f"the {drive_name} are ready"
        )
        yield
    finally:
        process.terminate()
        process.wait(10)


def run_triplet(
    machine: NamespaceMachine, folder: Path, *arguments: str, backend: str = "can"
) -> str:
    """Run the case study on the bus, and return the output."""
    bus = ("--set", f'backend.channels=["{CHANNEL}"]', "--out", str(folder / "run"))
    robot = ("triplet", "--backend", backend, "--set", "rate_hz=50")
    return machine.run(SNAKESIM, "run", *robot, *bus, *arguments, check=False, cwd=folder)


def run_in_realtime_to_end(
    machine: NamespaceMachine, folder: Path, *arguments: str, backend: str = "can"
) -> None:
    """Run the case study in real time, and check that it completes."""
    options = (*LISTEN_TO_POSE, "--clock-mode", "realtime", *arguments)
    output = run_triplet(machine, folder, *options, backend=backend)
    assert "(exit code 0)" in output, output


@pytest.mark.quiet
def test_external_modules_are_detected_and_driven_in_realtime(
    machine: NamespaceMachine, tmp_path: Path
) -> None:
    with running_emulated_drives(machine, tmp_path, "modules", "can"):
        scan = machine.run(SNAKESIM, "drive", "scan", "can", CHANNEL)
        assert scan.count(CHANNEL) == 13, scan
        run_in_realtime_to_end(machine, tmp_path, "--controller", "hold", "--duration", "2")


@pytest.mark.quiet
@pytest.mark.parametrize(
    ("driver_type", "command", "drive_name"),
    [
        pytest.param("odrive", "odrive", "axes", marks=pytest.mark.slow),
        ("moteus", "moteus", "controllers"),
        pytest.param("cia402", "cia402", "CiA 402 drives", marks=pytest.mark.slow),
    ],
)
def test_external_drives_are_driven_as_mounted_in_robot_file(
    machine: NamespaceMachine, tmp_path: Path, driver_type: str, command: str, drive_name: str
) -> None:
    """ODrives and CiA 402 drives use classic CAN; moteus uses CAN FD, with ids of 29 bits."""
    mounting = ("robot.joints.joint_2.sign=-1", "robot.joints.joint_5.zero_rad=0.4")
    gains = (
        ("backend.kp_nm_per_turn=1000", "backend.kd_nm_s_per_turn=100")
        if driver_type == "moteus"
        else ()
    )
    options: list[str] = []
    for key in (*mounting, *gains):
        options += ["--set", key]
    with running_emulated_drives(
        machine, tmp_path, drive_name, command, "--pose", POSE_ADDRESS, *options
    ):
        run_in_realtime_to_end(machine, tmp_path, "--duration", "4", *options, backend=driver_type)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["path_distance_m"] > 0.1


@pytest.mark.quiet
def test_external_modules_stop_when_controller_holds_the_interpreter(
    machine: NamespaceMachine, tmp_path: Path
) -> None:
    """Endless compiled code in the host's process stops the host, so that only the modules' watchdogs remain."""
    (tmp_path / "bad.py").write_text(BAD.replace("%s", "holds the interpreter"))
    with running_emulated_drives(machine, tmp_path, "modules", "can"):
        control_in_host = ("--set", "services.control.process=host", *LISTEN_TO_POSE)
        arguments = (
            "--controller",
            "./bad.py:Controller",
            "--clock-mode",
            "realtime",
            "--duration",
            "60",
            *control_in_host,
        )
        output = run_triplet(machine, tmp_path, *arguments)
        assert "(exit code 1)" in output, output
        scan = machine.run(SNAKESIM, "drive", "scan", "can", CHANNEL)
        assert scan.count("watchdog") == 13, output + scan
        assert " armed" not in scan, output + scan


TWO_GROUPS_CODE = """
import time
from snakesim_can_backend.bus.adapter import open_wire
from snakesim_can_backend.protocol.definitions import CanFrame
wires = [open_wire(f"udp_multicast:239.74.163.{group}") for group in (2, 2, 3)]
wires[0].send(CanFrame(0x105, b"12345678"))
time.sleep(0.2)
print("received:", [len(wire.receive()) for wire in wires])
for wire in wires:
    wire.close()
"""


def test_udp_multicast_channels_of_different_groups_are_separate_buses(
    machine: NamespaceMachine,
) -> None:
    """The groups share a port. Without an option of the socket, each channel would receive the frames of all groups."""
    assert "received: [0, 1, 0]" in machine.run(sys.executable, "-c", TWO_GROUPS_CODE)


@pytest.mark.slow
def test_run_with_own_emulated_modules_on_udp_multicast_moves(
    machine: NamespaceMachine, tmp_path: Path
) -> None:
    output = run_triplet(
        machine,
        tmp_path,
        "--clock-mode",
        "lockstep",
        "--duration",
        "2",
        "--set",
        'backend.emulators="process"',
    )
    assert "(exit code 0)" in output, output
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["path_distance_m"] > 0.02
