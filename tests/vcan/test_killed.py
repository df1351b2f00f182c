"""Processes that are killed with SIGKILL while the robot is armed, as a listener on the bus sees it.

Host, control and modules are the processes of `snakesim run` and `snakesim drive emulate can`; the listener has the
kernel's time of every frame. `pytest -rP tests/vcan/test_killed.py` prints a row for each.
"""

import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from snakesim_can_backend.can_command import COLUMNS
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    CommandAction,
    Frame,
    LastStop,
    ModuleState,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_hal.model.scenario import Override, RunConfig, load, write_config
from tests.e2e.command import Ended, environment
from tests.harness.endpoint import free_endpoint
from tests.harness.wait import wait_until
from tests.unit.hal.rig import write_files
from tests.vcan.link import FRAME
from tests.whole.command import snakesim

# Several processes in real time are more than a busy emulated machine is sure to keep up with: ARGS="-m slow".
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

JOINTS = 3
NODES = range(1, JOINTS + 1)
RATE_HZ = 25.0
IN_GUEST = os.environ.get("SNAKESIM_VCAN") == "guest"
# An emulated machine is slow, and wakes up late.
START_LIMIT_S, LATE_MS = (110.0, 150.0) if IN_GUEST else (30.0, 20.0)
SO_TIMESTAMPNS = 35  # asm-generic/socket.h

SCENARIO = f"""\
title = "Killed"
robot = "worm.toml"
scene = "bend.toml"
backend = "can"
controller = "hold"
clock_mode = "realtime"
rate_hz = {RATE_HZ}
[start]
tail_s_m = 0.1
[services.control]
[controllers.hold]
[backends.can]
channels = ["CHANNEL"]
physics_model = "inertia"
bring_up_limit_s = 60.0
[backends.can.physics_model_settings]
timestep_s = 0.01
"""


@dataclass(frozen=True)
class Heard:
    """A frame, and when it was on the bus by the kernel's clock."""

    at_ns: int
    frame: Frame

    @property
    def opcode(self) -> int:
        return parse_opcode(self.frame.id)

    def says(self) -> Mapping[str, float]:
        return load_layouts()[Opcode(self.opcode)].decode(self.frame.data)


class Listener:
    """Hears everything on a bus; the kernel keeps it until somebody asks."""

    def __init__(self, channel: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket.bind((channel,))
        self._socket.setblocking(False)
        self.heard: list[Heard] = []

    def listen(self) -> list[Heard]:
        """Take in what has come; everything heard since the last `forget`."""
        while True:
            try:
                data, extra, _, _ = self._socket.recvmsg(FRAME.size, socket.CMSG_SPACE(16))
            except BlockingIOError:
                return self.heard
            number, length, content = FRAME.unpack(data)
            seconds, nanoseconds = struct.unpack("=qq", extra[0][2])
            self.heard.append(Heard(seconds * 10**9 + nanoseconds, Frame(number, content[:length])))

    def forget(self) -> None:
        self.listen()
        self.heard = []

    def of(self, opcode: Opcode) -> list[Heard]:
        return [heard for heard in self.listen() if heard.opcode == opcode]

    def states(self) -> list[ModuleState]:
        """The state that each module told last, in whatever frame."""
        reported = dict.fromkeys(NODES, ModuleState.BOOT)
        for heard in self.listen():
            if heard.opcode in (Opcode.HEARTBEAT, Opcode.JOINT_STATE):
                reported[parse_node(heard.frame.id)] = ModuleState(int(heard.says()["state"]))
        return list(reported.values())

    def close(self) -> None:
        self._socket.close()


@dataclass
class Bench:
    """The processes of one robot on a bus; `start` and kill any."""

    folder: Path
    config: RunConfig
    endpoint: str
    listener: Listener
    running: ExitStack

    def start(self, name: str, *module_and_arguments: str) -> subprocess.Popen[bytes]:
        log = self.running.enter_context((self.folder / f"{name}.log").open("a"))
        process = subprocess.Popen(
            [sys.executable, "-m", *module_and_arguments, "--parent", str(os.getpid())],
            env=environment(self.folder),
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        self.running.enter_context(process)
        self.running.callback(process.kill)
        return process

    def modules(self) -> None:
        self.start("modules", "snakesim_can_backend.emulator.command", self._saved, "--pose", "none")
        self.until(lambda: "modules ready" in self.said("modules"), "modules ready")

    def control(self) -> subprocess.Popen[bytes]:
        return self.start(
            "control", "snakesim_hal.programs.service_program", "control", self._saved, "--endpoint", self.endpoint
        )

    @property
    def host_arguments(self) -> Sequence[str]:
        return (self._saved, "--endpoint", self.endpoint, "--out", str(self.folder))

    @property
    def _saved(self) -> str:
        return str(self.folder / "config.json")

    def said(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def until(self, condition: Callable[[], bool], what: str, limit_s: float = START_LIMIT_S) -> None:
        try:
            wait_until(condition, what, limit_s)
        except AssertionError as error:
            logs = "\n".join(f"{log.name}: {log.read_text()}" for log in self.folder.glob("*.log"))
            raise AssertionError(f"{error}\n{logs}") from None

    def tell(self, *arguments: str) -> Ended:
        """One of the operator's tools, told where the robot is."""
        return snakesim(*arguments, "--endpoint", self.endpoint, cwd=self.folder)

    def _is_armed(self) -> bool:
        """Once what there is has been cleared."""
        if self.tell("robot", "arm", self.config.robot.name, self.config.backend).code == 0:
            return True
        print(self.tell("robot", "reset").said)
        return False

    def arm(self) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        """Start modules, host and control, and wait until every module is armed. Returns the latter two processes."""
        self.modules()
        host = self.start("host", "snakesim_hal.programs.host_program", *self.host_arguments)
        self.until(lambda: len(self.listener.of(Opcode.SYNC)) > 20, "the driver's Syncs")
        control = self.control()
        self.until(self._is_armed, "ready to arm")
        self.listener.forget()
        armed = [ModuleState.ARMED] * JOINTS
        self.until(lambda: self.listener.states() == armed, "every module armed")
        self.until(lambda: len(self.listener.of(Opcode.SET_POINT)) > 10 * JOINTS, "setpoints")
        return host, control


@contextmanager
def bench(folder: Path, channel: str) -> Iterator[Bench]:
    scenario = write_files(folder, scenario=SCENARIO.replace("CHANNEL", channel))
    config = load(scenario, [Override("robot.chain.modules", JOINTS, "test")]).config
    write_config(config, folder / "config.json")
    with ExitStack() as running, closing(Listener(channel)) as listener:
        yield Bench(folder, config, free_endpoint(), listener, running)


@pytest.fixture
def robot(tmp_path: Path, channel: str) -> Iterator[Bench]:
    with bench(tmp_path, channel) as made:
        yield made


def killed(process: subprocess.Popen[bytes]) -> int:
    """SIGKILL; when, by the clock of the listener."""
    now_ns = time.time_ns()
    process.kill()
    process.wait()
    return now_ns


def stop_commands(heard: Sequence[Heard]) -> list[Heard]:
    return [h for h in heard if h.opcode == Opcode.COMMAND and h.says()["action"] == CommandAction.STOP]


def first_in(heard: Sequence[Heard], states: set[ModuleState], since_ns: int) -> dict[int, Heard]:
    """Each module's first frame after a time that tells one of these states."""
    found: dict[int, Heard] = {}
    for h in heard:
        if h.at_ns >= since_ns and h.opcode in (Opcode.HEARTBEAT, Opcode.JOINT_STATE) and h.says()["state"] in states:
            found.setdefault(parse_node(h.frame.id), h)
    return found


def uptimes_ms(heard: Sequence[Heard], node: int) -> list[tuple[int, float]]:
    """(kernel's time, module's uptime) of its heartbeats."""
    beats = [h for h in heard if h.opcode == Opcode.HEARTBEAT and parse_node(h.frame.id) == node]
    return [(h.at_ns, 1e3 * h.says()["uptime"]) for h in beats]


def passed_for_module_ms(heard: Sequence[Heard], node: int, from_ns: int, to_ns: int) -> float:
    """How long a stretch of the kernel's time took in a module's own; heartbeats around it give both."""
    at_ns, uptime_ms = zip(*uptimes_ms(heard, node), strict=True)
    from_ms, to_ms = np.interp([from_ns - at_ns[0], to_ns - at_ns[0]], [ns - at_ns[0] for ns in at_ns], uptime_ms)
    return float(to_ms - from_ms)


def test_a_killed_controller_makes_the_driver_stop_the_modules(robot: Bench) -> None:
    _, control = robot.arm()
    killed_ns = killed(control)
    passive = {ModuleState.DISARMED}
    robot.until(lambda: len(first_in(robot.listener.listen(), passive, killed_ns)) == JOINTS, "modules stopped")
    robot.until(lambda: "lease of control expired" in robot.tell("status").said, "the fault in the status")
    heard = list(robot.listener.listen())
    last_ms = (max(h.at_ns for h in heard if h.opcode == Opcode.SET_POINT) - killed_ns) / 1e6
    stop = next(h for h in stop_commands(heard) if h.at_ns > killed_ns)
    stop_ms = (stop.at_ns - killed_ns) / 1e6
    rest_ms = max((h.at_ns - stop.at_ns) / 1e6 for h in first_in(heard, passive, killed_ns).values())
    lease_ms, period_ms = robot.config.lease_ns / 1e6, robot.config.period_ns / 1e6
    assert last_ms <= stop_ms <= lease_ms + 2 * period_ms + LATE_MS
    assert rest_ms <= 100 + period_ms + LATE_MS
    print(
        f"| control, SIGKILL | last setpoint {last_ms:.0f} ms after it, Stop {stop_ms:.0f} ms "
        f"(lease {lease_ms:.0f} ms, {RATE_HZ:g} Hz) | all modules DISARMED {rest_ms:.0f} ms after Stop "
        f"| kernel's clock{', emulated machine' if IN_GUEST else ''} |"
    )


def test_a_killed_host_leaves_every_module_to_its_own_watchdog(robot: Bench, channel: str) -> None:
    host, _ = robot.arm()
    armed = [ModuleState.ARMED] * JOINTS
    assert robot.listener.states() == armed, robot.said("host")
    killed_ns = killed(host)
    period_ms = robot.config.period_ns / 1e6
    fault = {ModuleState.FAULT}
    robot.until(lambda: len(first_in(robot.listener.listen(), fault, killed_ns)) == JOINTS, "modules in fault")
    beats = {node: len(uptimes_ms(robot.listener.listen(), node)) for node in NODES}
    robot.until(
        lambda: all(len(uptimes_ms(robot.listener.listen(), node)) > beats[node] + 1 for node in NODES),
        "heartbeats",
    )
    heard = robot.listener.heard
    stopped = first_in(heard, fault, killed_ns)
    assert all(h.opcode == Opcode.HEARTBEAT for h in stopped.values()), "told at once, without a Sync"
    assert {h.says()["last_stop"] for h in stopped.values()} == {LastStop.WATCHDOG}
    assert all(h.says()["fault_watchdog"] and h.says()["mode"] == 0 for h in stopped.values())
    last = {
        node: max(h.at_ns for h in heard if h.opcode == Opcode.SET_POINT and parse_node(h.frame.id) == node)
        for node in NODES
    }
    from_host = [h.at_ns for h in heard if h.opcode in (Opcode.SET_POINT, Opcode.SYNC, Opcode.COMMAND)]
    last_ms = (max(from_host) - killed_ns) / 1e6
    took_ms = [(stopped[node].at_ns - last[node]) / 1e6 for node in NODES]
    own_ms = [passed_for_module_ms(heard, node, last[node], stopped[node].at_ns) for node in NODES]
    assert last_ms < LATE_MS
    assert max(took_ms) <= 100 + period_ms + LATE_MS
    assert max(own_ms) <= 100 + period_ms and min(own_ms) > 100 - period_ms
    assert robot.listener.states() == [ModuleState.FAULT] * JOINTS
    print(
        f"| host, SIGKILL | last frame {last_ms:.1f} ms after it | all modules FAULT (watchdog), "
        f"motor off, {max(took_ms):.0f} ms after their last setpoint by the kernel's clock, "
        f"{min(own_ms):.0f} to {max(own_ms):.0f} ms by their own | watchdog 100 ms |"
    )

    # Whoever looks afterwards sees it.
    scanned = snakesim("drive", "scan", "can", channel, "--duration", "3", cwd=robot.folder)
    lines = scanned.out.splitlines()
    assert scanned.code == 0 and lines[0].split() == list(COLUMNS), scanned.out + scanned.err
    rows = [dict(zip(COLUMNS, line.split(), strict=False)) for line in lines[1:]]
    assert [r["node"] for r in rows] == [str(node) for node in NODES]
    assert all((r["emulated"], r["state"], r["faults"]) == ("yes", "fault", "watchdog") for r in rows)
    assert len({r["serial"] for r in rows}) == JOINTS
    print(f"| `snakesim drive scan can {channel}` afterwards | {'; '.join(' '.join(line.split()) for line in lines)} |")
