"""Runs the processes of one robot on a CAN bus of the kernel, and receives every frame on this bus.

The kernel timestamps the frames. Thus a test measures when a module stopped without a delay of its own.
"""

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
from snakesim_testing.can.interface import FRAME_LAYOUT
from snakesim_testing.hal.small_robots import write_scenario_files
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import CompletedRun, make_environment
from snakesim_testing.runs.in_process_command import snakesim

JOINT_COUNT = 3
NODES = range(1, JOINT_COUNT + 1)
RATE_HZ = 25.0

IN_GUEST = os.environ.get("SNAKESIM_VCAN") == "guest"
if IN_GUEST:  # an emulated machine is slow, and wakes up late
    START_LIMIT_S = 110.0
    LATE_MS = 150.0
else:
    START_LIMIT_S = 30.0
    LATE_MS = 20.0

SO_TIMESTAMPNS = 35  # asm-generic/socket.h
RECEIVE_BUFFER_BYTES = 1 << 22  # the kernel keeps all frames of a test

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
    """A frame, and the time of the kernel's clock at which it was on the bus."""

    at_ns: int
    frame: CanFrame

    @property
    def opcode(self) -> int:
        return parse_opcode(self.frame.id)

    @property
    def node(self) -> int:
        return parse_node(self.frame.id)

    def decode(self) -> Mapping[str, float]:
        """Return the values of the signals in the frame, by their names."""
        return load_layouts()[Opcode(self.opcode)].decode(self.frame.data)

    def has_state(self) -> bool:
        """Return whether the frame reports the state of a module."""
        return self.opcode in (Opcode.HEARTBEAT, Opcode.JOINT_STATE)

    def decode_state(self) -> ModuleState:
        """Return the state of the module that sent this frame, which must be one with a state."""
        return ModuleState(int(self.decode()["state"]))


class BusListener:
    """Receives every frame on a bus. The kernel buffers the frames until `receive_frames`."""

    def __init__(self, channel: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self._socket.bind((channel,))
        self._socket.setblocking(False)
        self.received: list[ReceivedFrame] = []

    def receive_frames(self) -> list[ReceivedFrame]:
        """Receive the buffered frames, and return all frames since the last `discard_frames`."""
        while True:
            try:
                data, extra, _, _ = self._socket.recvmsg(FRAME_LAYOUT.size, socket.CMSG_SPACE(16))
            except BlockingIOError:
                return self.received
            frame_id, length, content = FRAME_LAYOUT.unpack(data)
            seconds, nanoseconds = struct.unpack("=qq", extra[0][2])
            at_ns = seconds * 10**9 + nanoseconds
            self.received.append(ReceivedFrame(at_ns, CanFrame(frame_id, content[:length])))

    def discard_frames(self) -> None:
        """Discard all frames that were on the bus until now."""
        self.receive_frames()
        self.received = []

    def read_frames_of(self, opcode: Opcode) -> list[ReceivedFrame]:
        """Return all frames with this opcode since the last `discard_frames`."""
        return [frame for frame in self.receive_frames() if frame.opcode == opcode]

    def states(self) -> list[ModuleState]:
        """Return the state that each module reported last, in any frame."""
        state_by_node = dict.fromkeys(NODES, ModuleState.BOOT)
        for frame in self.receive_frames():
            if frame.has_state():
                state_by_node[frame.node] = frame.decode_state()
        return list(state_by_node.values())

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@dataclass
class RobotOnBus:
    """The processes of one robot on a bus. A test starts them one by one, and can kill each of them."""

    folder: Path
    config: RunConfig
    endpoint: str
    listener: BusListener
    running: ExitStack

    def start(self, name: str, *module_and_arguments: str) -> subprocess.Popen[bytes]:
        """Start a Python module as a process whose output goes to a log with this name."""
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

    def start_modules(self) -> None:
        """Start the emulated joint modules, and wait until they are ready."""
        program = "snakesim_can_backend.emulator.command"
        self.start("modules", program, self._config_path, "--pose", "none")
        self.wait_until(lambda: "modules ready" in self.read_log("modules"), "modules ready")

    def start_control(self) -> subprocess.Popen[bytes]:
        """Start the control process."""
        program = "snakesim_hal.programs.service_program"
        return self.start(
            "control", program, "control", self._config_path, "--endpoint", self.endpoint
        )

    @property
    def host_arguments(self) -> Sequence[str]:
        """The arguments of the host program."""
        return (self._config_path, "--endpoint", self.endpoint, "--out", str(self.folder))

    @property
    def _config_path(self) -> str:
        return str(self.folder / "config.json")

    def read_log(self, name: str) -> str:
        """Return the output of the process with this name."""
        return (self.folder / f"{name}.log").read_text()

    def wait_until(
        self, condition: Callable[[], bool], description: str, limit_s: float = START_LIMIT_S
    ) -> None:
        """Wait until a condition is true. A failure contains the logs of all processes."""
        try:
            wait_until(condition, description, limit_s)
        except AssertionError as error:
            logs = "\n".join(f"{log.name}: {log.read_text()}" for log in self.folder.glob("*.log"))
            raise AssertionError(f"{error}\n{logs}") from None

    def run_command(self, *arguments: str) -> CompletedRun:
        """Run one of the operator's tools with the endpoint of the robot."""
        return snakesim(*arguments, "--endpoint", self.endpoint, cwd=self.folder)

    def arm(self) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        """Start modules, host and control, and wait until every module is armed.

        Returns:
            The processes of the host and of control.
        """
        self.start_modules()
        host = self.start("host", "snakesim_hal.programs.host_program", *self.host_arguments)
        self._wait_for_frames(Opcode.SYNC, 20)
        control = self.start_control()
        self.wait_until(self._try_to_arm, "ready to arm")
        self.listener.discard_frames()
        all_armed = [ModuleState.ARMED] * JOINT_COUNT
        self.wait_until(lambda: self.listener.states() == all_armed, "every module armed")
        self._wait_for_frames(Opcode.SET_POINT, 10 * JOINT_COUNT)
        return host, control

    def _try_to_arm(self) -> bool:
        """Return whether the robot could be armed. If not, reset its fault."""
        robot_name = self.config.robot.name
        if self.run_command("robot", "arm", robot_name, self.config.backend).code == 0:
            return True
        print(self.run_command("robot", "reset").printed)
        return False

    def _wait_for_frames(self, opcode: Opcode, count: int) -> None:
        self.wait_until(
            lambda: len(self.listener.read_frames_of(opcode)) > count,
            f"more than {count} frames {opcode.name}",
        )


@contextmanager
def open_robot_on_bus(folder: Path, channel: str) -> Iterator[RobotOnBus]:
    """Write the files of a robot, listen to its bus, and end all its processes with the context.

    Args:
        folder: Gets the files and the logs.
        channel: Name of the CAN interface.
    """
    scenario = write_scenario_files(folder, scenario=SCENARIO.replace("CHANNEL", channel))
    joint_count = KeyOverride("robot.chain.modules", JOINT_COUNT, "test")
    config = load_scenario(scenario, [joint_count]).config
    write_config(config, folder / "config.json")
    with ExitStack() as running, closing(BusListener(channel)) as listener:
        yield RobotOnBus(folder, config, find_free_endpoint(), listener, running)


def select_stop_commands(received: Sequence[ReceivedFrame]) -> list[ReceivedFrame]:
    """Return the frames that command a stop."""
    commands = [frame for frame in received if frame.opcode == Opcode.COMMAND]
    return [frame for frame in commands if frame.decode()["action"] == CommandAction.STOP]


def find_first_reports(
    received: Sequence[ReceivedFrame], states: set[ModuleState], since_ns: int
) -> dict[int, ReceivedFrame]:
    """Return each module's first frame since a time that reports one of these states, by node id."""
    first_by_node: dict[int, ReceivedFrame] = {}
    for frame in received:
        if frame.at_ns < since_ns or not frame.has_state():
            continue
        if frame.decode()["state"] in states:
            first_by_node.setdefault(frame.node, frame)
    return first_by_node


def read_uptimes_ms(received: Sequence[ReceivedFrame], node_id: int) -> list[tuple[int, float]]:
    """Return the time of the kernel's clock, in ns, and the module's uptime for each heartbeat of a module."""
    heartbeats = [
        frame for frame in received if frame.opcode == Opcode.HEARTBEAT and frame.node == node_id
    ]
    return [(frame.at_ns, 1e3 * frame.decode()["uptime"]) for frame in heartbeats]


def measure_module_duration_ms(
    received: Sequence[ReceivedFrame], node_id: int, from_ns: int, to_ns: int
) -> float:
    """Return how much time passed on the clock of a module between two times of the kernel's clock.

    Each heartbeat contains both times. Those between two heartbeats are interpolated.
    """
    at_ns, uptimes_ms = zip(*read_uptimes_ms(received, node_id), strict=True)
    start_ns = at_ns[0]  # subtracted first, because large numbers of ns are inexact as floats
    from_ms, to_ms = np.interp(
        [from_ns - start_ns, to_ns - start_ns], [ns - start_ns for ns in at_ns], uptimes_ms
    )
    return float(to_ms - from_ms)
