"""A bus through python-can: two processes over UDP multicast, on the loopback of a machine of its own.

Emulated drives come before other processes: real ones do not wait for a computer's tests.
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

CHANNEL, POSE = "udp_multicast:239.74.163.2", "127.0.0.1:7450"
LISTENING = ("--set", f'backend.pose_listen="{POSE}"')
SNAKESIM = str(Path(sys.executable).with_name("snakesim"))


@pytest.fixture
def machine() -> Iterator[NamespaceMachine]:
    with ExitStack() as stack:
        one = NamespaceMachine(stack)
        one.run("ip", "link", "set", "lo", "multicast", "on")
        one.run("ip", "route", "add", "239.0.0.0/8", "dev", "lo")
        yield one


@contextmanager
def drives(machine: NamespaceMachine, folder: Path, ready: str, *command: str) -> Iterator[None]:
    """Emulated drives of another program on the bus."""
    log, typed = (
        folder / "drives.log",
        ("drive", "emulate", command[0], "triplet", "--channel", CHANNEL, *command[1:]),
    )
    process = machine.start(SNAKESIM, *typed, log=log, hurried=True)
    try:
        wait_until(lambda: f"{ready} ready: 13" in log.read_text(), f"the {ready}")
        yield
    finally:
        process.terminate()
        process.wait(10)


def run(machine: NamespaceMachine, folder: Path, *arguments: str, backend: str = "can") -> str:
    where = ("--set", f'backend.channels=["{CHANNEL}"]', "--out", str(folder / "run"))
    robot = ("triplet", "--backend", backend, "--set", "rate_hz=50", *where)
    return machine.run(SNAKESIM, "run", *robot, *arguments, check=False, cwd=folder)


def completes(
    machine: NamespaceMachine, folder: Path, *arguments: str, backend: str = "can"
) -> None:
    """A run in real time to its end."""
    said = run(machine, folder, *LISTENING, "--clock-mode", "realtime", *arguments, backend=backend)
    assert "(exit code 0)" in said, said


@pytest.mark.quiet
def test_external_modules_are_detected_and_driven_in_real_time(
    machine: NamespaceMachine, tmp_path: Path
) -> None:
    with drives(machine, tmp_path, "modules", "can"):
        found = machine.run(SNAKESIM, "drive", "scan", "can", CHANNEL)
        assert found.count(CHANNEL) == 13, found
        completes(machine, tmp_path, "--controller", "hold", "--duration", "2")


@pytest.mark.quiet
@pytest.mark.parametrize(
    ("driver_type", "command", "of"),
    [
        pytest.param("odrive", "odrive", "axes", marks=pytest.mark.slow),
        ("moteus", "moteus", "controllers"),
        pytest.param("cia402", "cia402", "CiA 402 drives", marks=pytest.mark.slow),
    ],
)
def test_external_drives_are_driven_as_mounted_in_robot_file(
    machine: NamespaceMachine, tmp_path: Path, driver_type: str, command: str, of: str
) -> None:
    """ODrives and CiA 402 drives on classic CAN; moteus on CAN FD, with ids of 29 bits."""
    built = ("robot.joints.joint_2.sign=-1", "robot.joints.joint_5.zero_rad=0.4")
    gains = (
        ("backend.kp_nm_per_turn=1000", "backend.kd_nm_s_per_turn=100")
        if driver_type == "moteus"
        else ()
    )
    sets = [word for text in (*built, *gains) for word in ("--set", text)]
    with drives(machine, tmp_path, of, command, "--pose", POSE, *sets):
        completes(machine, tmp_path, "--duration", "4", *sets, backend=driver_type)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["path_distance_m"] > 0.1


@pytest.mark.slow
def test_external_modules_stop_when_controller_holds_the_interpreter(
    machine: NamespaceMachine, tmp_path: Path
) -> None:
    """Beside the driver compiled code without end stops the host: what is left is the modules' own watchdog."""
    (tmp_path / "bad.py").write_text(BAD.replace("%s", "holds the interpreter"))
    with drives(machine, tmp_path, "modules", "can"):
        beside = ("--set", "services.control.process=host", *LISTENING)
        bad = (
            "--controller",
            "./bad.py:Controller",
            "--clock-mode",
            "realtime",
            "--duration",
            "60",
            *beside,
        )
        said = run(machine, tmp_path, *bad)
        assert "(exit code 1)" in said, said
        found = machine.run(SNAKESIM, "drive", "scan", "can", CHANNEL)
        assert found.count("watchdog") == 13 and " armed" not in found, said + found


TWO_GROUPS = """
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


def test_channels_of_udp_multicast_are_buses_of_their_own(machine: NamespaceMachine) -> None:
    """They share a port: without an option of its socket each of them gets the frames of all groups."""
    assert "received: [0, 1, 0]" in machine.run(sys.executable, "-c", TWO_GROUPS)


@pytest.mark.slow
def test_its_own_modules_move_in_lockstep_as_on_any_bus(
    machine: NamespaceMachine, tmp_path: Path
) -> None:
    said = run(
        machine,
        tmp_path,
        "--clock-mode",
        "lockstep",
        "--duration",
        "2",
        "--set",
        'backend.emulators="process"',
    )
    assert "(exit code 0)" in said, said
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["path_distance_m"] > 0.02
