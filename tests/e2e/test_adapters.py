"""A bus through python-can: two processes over UDP multicast, on the loopback of a machine of its own.

Emulated drives come before other processes: real ones do not wait for a computer's tests.
"""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.e2e.test_beside import BAD
from tests.harness.wait import wait_until
from tests.machines import Machine

pytestmark = [pytest.mark.e2e, pytest.mark.skipif(os.geteuid() != 0, reason="makes a network namespace: needs root")]
pytest.importorskip("msgpack", reason="python-can's UDP bus needs it")

CHANNEL = "udp_multicast:239.74.163.2"
SNAKESIM = str(Path(sys.executable).with_name("snakesim"))


@pytest.fixture
def machine() -> Iterator[Machine]:
    with ExitStack() as stack:
        one = Machine(stack)
        one.run("ip", "link", "set", "lo", "multicast", "on")
        one.run("ip", "route", "add", "239.0.0.0/8", "dev", "lo")
        yield one


def run(machine: Machine, folder: Path, *arguments: str) -> str:
    where = ("--set", f'backend.channels=["{CHANNEL}"]', "--out", str(folder / "run"))
    robot = ("triplet", "--backend", "can", "--set", "rate_hz=50", *where)
    return machine.run(SNAKESIM, "run", *robot, *arguments, check=False, cwd=folder)


def test_modules_of_another_program_are_found_and_driven_in_real_time(machine: Machine, tmp_path: Path) -> None:
    log = tmp_path / "modules.log"
    modules = machine.start(SNAKESIM, "modules", "triplet", "--channel", CHANNEL, log=log, hurried=True)
    try:
        wait_until(lambda: "modules ready: 13" in log.read_text(), "the modules")
        found = machine.run(SNAKESIM, "can", "scan", CHANNEL)
        assert found.count(CHANNEL) == 13, found
        listening = ("--set", 'backend.pose_listen="127.0.0.1:7450"')
        hold = ("--controller", "hold", "--pace", "realtime", "--duration", "2", *listening)
        said = [""]
        while "(exit code 0)" not in said[-1] and len(said) < 5:  # a computer that stutters stops a robot now and then
            said.append(run(machine, tmp_path, *hold))
        assert "(exit code 0)" in said[-1], "\n".join(said)
    finally:
        modules.terminate()
        modules.wait(10)


@pytest.mark.parametrize(
    ("family", "command", "of"), [("odrive", "odrives", "axes"), ("moteus", "moteus", "controllers")]
)
def test_drives_of_another_program_are_driven_in_real_time_as_the_robot_file_says_they_are_mounted(
    machine: Machine, tmp_path: Path, family: str, command: str, of: str
) -> None:
    """ODrives on classic CAN; moteus on CAN FD, with ids of 29 bits."""
    built = ("robot.joints.joint_2.sign=-1", "robot.joints.joint_5.zero_rad=0.4")
    gains = ("backend.kp_nm_per_turn=1000", "backend.kd_nm_s_per_turn=100") if family == "moteus" else ()
    sets = [word for text in (*built, *gains) for word in ("--set", text)]
    log = tmp_path / "drives.log"
    started = (command, "triplet", "--channel", CHANNEL, "--pose", "127.0.0.1:7450", *sets)
    drives = machine.start(SNAKESIM, *started, log=log, hurried=True)
    try:
        wait_until(lambda: f"{of} ready: 13" in log.read_text(), "the drives")
        where = ("--set", f'backend.channels=["{CHANNEL}"]', "--set", 'backend.pose_listen="127.0.0.1:7450"')
        real = ("--backend", family, "--set", "rate_hz=50", "--pace", "realtime", "--duration", "4", *where)
        said = [""]
        while "(exit code 0)" not in said[-1] and len(said) < 5:  # a computer that stutters stops a robot now and then
            run_to = ("triplet", *real, *sets, "--out", str(tmp_path / "run"))
            said.append(machine.run(SNAKESIM, "run", *run_to, check=False, cwd=tmp_path))
        assert "(exit code 0)" in said[-1], "\n".join(said)
        assert json.loads((tmp_path / "run" / "summary.json").read_text())["path_distance_m"] > 0.1
    finally:
        drives.terminate()
        drives.wait(10)


@pytest.mark.slow
def test_modules_stop_by_themselves_when_the_controller_holds_the_hosts_interpreter(
    machine: Machine, tmp_path: Path
) -> None:
    """Beside the driver compiled code without end stops the host: what is left is the modules' own watchdog."""
    (tmp_path / "bad.py").write_text(BAD.replace("%s", "holds the interpreter"))
    log = tmp_path / "modules.log"
    modules = machine.start(SNAKESIM, "modules", "triplet", "--channel", CHANNEL, log=log, hurried=True)
    try:
        wait_until(lambda: "modules ready: 13" in log.read_text(), "the modules")
        beside = ("--set", "services.control.place=host", "--set", 'backend.pose_listen="127.0.0.1:7450"')
        bad = ("--controller", "./bad.py:Controller", "--pace", "realtime", "--duration", "60", *beside)
        said = run(machine, tmp_path, *bad)
        assert "(exit code 1)" in said, said
        found = machine.run(SNAKESIM, "can", "scan", CHANNEL)
        assert found.count("watchdog") == 13 and " armed" not in found, said + found
    finally:
        modules.terminate()
        modules.wait(10)


def test_its_own_modules_move_in_lockstep_as_on_any_bus(machine: Machine, tmp_path: Path) -> None:
    said = run(machine, tmp_path, "--pace", "lockstep", "--duration", "2", "--set", 'backend.twins="process"')
    assert "(exit code 0)" in said, said
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["path_distance_m"] > 0.02
