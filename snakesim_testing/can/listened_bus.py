"""A robot on a kernel's CAN bus, and a listener on it."""

import os
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    ModuleState,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario, write_config
from snakesim_testing.can.interface import FRAME
from snakesim_testing.hal.small_robots import write_scenario_files
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import CompletedRun, make_environment
from snakesim_testing.runs.in_process_command import snakesim

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
class ReceivedFrame:
    """A frame, and when it was on the bus by the kernel's clock."""

    at_ns: int
    frame: CanFrame

    @property
    def opcode(self) -> int:
        return parse_opcode(self.frame.id)

    def decode(self) -> Mapping[str, float]:
        return load_layouts()[Opcode(self.opcode)].decode(self.frame.data)


class BusListener:
    """Receives every frame on a bus; the kernel buffers them until `listen`."""

    def __init__(self, channel: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket.bind((channel,))
        self._socket.setblocking(False)
        self.received: list[ReceivedFrame] = []

    def listen(self) -> list[ReceivedFrame]:
        """Receive the buffered frames; return all received since the last `forget`."""
        while True:
            try:
                data, extra, _, _ = self._socket.recvmsg(FRAME.size, socket.CMSG_SPACE(16))
            except BlockingIOError:
                return self.received
            number, length, content = FRAME.unpack(data)
            seconds, nanoseconds = struct.unpack("=qq", extra[0][2])
            self.received.append(
                ReceivedFrame(seconds * 10**9 + nanoseconds, CanFrame(number, content[:length]))
            )

    def forget(self) -> None:
        self.listen()
        self.received = []

    def read_frames_of(self, opcode: Opcode) -> list[ReceivedFrame]:
        return [frame for frame in self.listen() if frame.opcode == opcode]

    def states(self) -> list[ModuleState]:
        """The state that each module reported last, in any frame."""
        reported = dict.fromkeys(NODES, ModuleState.BOOT)
        for frame in self.listen():
            if frame.opcode in (Opcode.HEARTBEAT, Opcode.JOINT_STATE):
                reported[parse_node(frame.frame.id)] = ModuleState(int(frame.decode()["state"]))
        return list(reported.values())

    def close(self) -> None:
        self._socket.close()


@dataclass
class RobotOnBus:
    """The processes of one robot on a bus; `start` and kill any."""

    folder: Path
    config: RunConfig
    endpoint: str
    listener: BusListener
    running: ExitStack

    def start(self, name: str, *module_and_arguments: str) -> subprocess.Popen[bytes]:
        log = self.running.enter_context((self.folder / f"{name}.log").open("a"))
        process = subprocess.Popen(
            [sys.executable, "-m", *module_and_arguments, "--parent", str(os.getpid())],
            env=make_environment(self.folder),
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        self.running.enter_context(process)
        self.running.callback(process.kill)
        return process

    def modules(self) -> None:
        self.start(
            "modules", "snakesim_can_backend.emulator.command", self._saved, "--pose", "none"
        )
        self.until(lambda: "modules ready" in self.read_log("modules"), "modules ready")

    def control(self) -> subprocess.Popen[bytes]:
        return self.start(
            "control",
            "snakesim_hal.programs.service_program",
            "control",
            self._saved,
            "--endpoint",
            self.endpoint,
        )

    @property
    def host_arguments(self) -> Sequence[str]:
        return (self._saved, "--endpoint", self.endpoint, "--out", str(self.folder))

    @property
    def _saved(self) -> str:
        return str(self.folder / "config.json")

    def read_log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def until(
        self, condition: Callable[[], bool], what: str, limit_s: float = START_LIMIT_S
    ) -> None:
        try:
            wait_until(condition, what, limit_s)
        except AssertionError as error:
            logs = "\n".join(f"{log.name}: {log.read_text()}" for log in self.folder.glob("*.log"))
            raise AssertionError(f"{error}\n{logs}") from None

    def run_command(self, *arguments: str) -> CompletedRun:
        """Run one of the operator's tools with the endpoint of the robot."""
        return snakesim(*arguments, "--endpoint", self.endpoint, cwd=self.folder)

    def _is_armed(self) -> bool:
        """Once what there is has been cleared."""
        if self.run_command("robot", "arm", self.config.robot.name, self.config.backend).code == 0:
            return True
        print(self.run_command("robot", "reset").printed)
        return False

    def arm(self) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        """Start modules, host and control, and wait until every module is armed. Returns the latter two processes."""
        self.modules()
        host = self.start("host", "snakesim_hal.programs.host_program", *self.host_arguments)
        self.until(
            lambda: len(self.listener.read_frames_of(Opcode.SYNC)) > 20, "the driver's Syncs"
        )
        control = self.control()
        self.until(self._is_armed, "ready to arm")
        self.listener.forget()
        armed = [ModuleState.ARMED] * JOINTS
        self.until(lambda: self.listener.states() == armed, "every module armed")
        self.until(
            lambda: len(self.listener.read_frames_of(Opcode.SET_POINT)) > 10 * JOINTS, "setpoints"
        )
        return host, control


@contextmanager
def bench(folder: Path, channel: str) -> Iterator[RobotOnBus]:
    scenario = write_scenario_files(folder, scenario=SCENARIO.replace("CHANNEL", channel))
    config = load_scenario(scenario, [KeyOverride("robot.chain.modules", JOINTS, "test")]).config
    write_config(config, folder / "config.json")
    with ExitStack() as running, closing(BusListener(channel)) as listener:
        yield RobotOnBus(folder, config, find_free_endpoint(), listener, running)


def stop_commands(received: Sequence[ReceivedFrame]) -> list[ReceivedFrame]:
    return [
        h
        for h in received
        if h.opcode == Opcode.COMMAND and h.decode()["action"] == CommandAction.STOP
    ]


def first_in(
    received: Sequence[ReceivedFrame], states: set[ModuleState], since_ns: int
) -> dict[int, ReceivedFrame]:
    """Each module's first frame after a time that reports one of these states."""
    first: dict[int, ReceivedFrame] = {}
    for h in received:
        if (
            h.at_ns >= since_ns
            and h.opcode in (Opcode.HEARTBEAT, Opcode.JOINT_STATE)
            and h.decode()["state"] in states
        ):
            first.setdefault(parse_node(h.frame.id), h)
    return first


def uptimes_ms(received: Sequence[ReceivedFrame], node_id: int) -> list[tuple[int, float]]:
    """(kernel's time, module's uptime) of its heartbeats."""
    beats = [
        h for h in received if h.opcode == Opcode.HEARTBEAT and parse_node(h.frame.id) == node_id
    ]
    return [(h.at_ns, 1e3 * h.decode()["uptime"]) for h in beats]


def passed_for_module_ms(
    received: Sequence[ReceivedFrame], node_id: int, from_ns: int, to_ns: int
) -> float:
    """How long a stretch of the kernel's time took in a module's own; heartbeats around it give both."""
    at_ns, uptime_ms = zip(*uptimes_ms(received, node_id), strict=True)
    from_ms, to_ms = np.interp(
        [from_ns - at_ns[0], to_ns - at_ns[0]], [ns - at_ns[0] for ns in at_ns], uptime_ms
    )
    return float(to_ms - from_ms)
