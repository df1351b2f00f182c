"""A virtual bus that keeps its frames, and helpers that read what the driver has sent.

The wires of a test are in `WIRES`, in the order in which the driver opened them.
"""

from collections.abc import Callable

from snakesim_can_backend.bus.bus import VirtualPeer, VirtualWire
from snakesim_can_backend.emulator.firmware import ModuleFirmware
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    CanFrame,
    CommandAction,
    ModuleState,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_hal.wire.messages import LifecycleState
from snakesim_testing.can.driver_loop import DriverLoop, find_chain
from snakesim_testing.can.frames import decode_signals

ARMED = ModuleState.ARMED
DISARMED = ModuleState.DISARMED
EMERGENCY = ModuleState.EMERGENCY
FrameFilter = Callable[[CanFrame], bool]


def match_no_frame(_frame: CanFrame) -> bool:
    """Return False for every frame."""
    return False


class RecordingWire(VirtualWire):
    """A virtual bus that records its frames. It refuses, loses or ignores the frames that a test selects."""

    def __init__(self, channel: str, peer: VirtualPeer | None = None) -> None:
        super().__init__(channel, peer)
        self.sent: list[CanFrame] = []  # by the driver
        self.all_frames: list[CanFrame] = []
        self.should_refuse: FrameFilter = match_no_frame  # `send` reports a failure
        self.should_lose: FrameFilter = (
            match_no_frame  # `send` reports success, but no module gets it
        )
        self.should_ignore: FrameFilter = match_no_frame  # the driver does not receive it
        self.close_count = 0
        WIRES.append(self)

    def send(self, frame: CanFrame) -> bool:
        if self.should_refuse(frame):
            return False
        self.sent.append(frame)
        self.all_frames.append(frame)
        return self.should_lose(frame) or super().send(frame)

    def receive(self) -> list[CanFrame]:
        frames = [frame for frame in super().receive() if not self.should_ignore(frame)]
        self.all_frames += frames
        return frames

    def close(self) -> None:
        self.close_count += 1
        super().close()


WIRES: list[RecordingWire] = []


def is_action(frame: CanFrame, *actions: CommandAction) -> bool:
    """Return whether a frame is a command with one of these actions."""
    if parse_opcode(frame.id) != Opcode.COMMAND:
        return False
    return decode_signals(frame)["action"] in actions


def is_setpoint(frame: CanFrame) -> bool:
    """Return whether a frame is a setpoint."""
    return parse_opcode(frame.id) == Opcode.SET_POINT


def describe_host_frames(frames: list[CanFrame]) -> list[str]:
    """Return the commands and emergency stops among the frames as text.

    A command for one module is followed by the id of its node, as in "clear 2".
    """
    descriptions = list[str]()
    for frame in frames:
        opcode = Opcode(parse_opcode(frame.id))
        if opcode == Opcode.COMMAND:
            action = CommandAction(int(decode_signals(frame)["action"])).name.lower()
            node = parse_node(frame.id)
            descriptions.append(action if node == BROADCAST else f"{action} {node}")
        elif opcode == Opcode.EMERGENCY:
            descriptions.append("emergency")
    return descriptions


def find_module(loop: DriverLoop, node_id: int) -> ModuleFirmware:
    """Return the emulated module with this node id."""
    return find_chain(loop.backend).slots[node_id - 1].module


def run_in_lifecycle_state(
    loop: DriverLoop, lifecycle: LifecycleState, ticks: int = 1
) -> list[CanFrame]:
    """Run control cycles in one lifecycle state, even if the driver reports a fault.

    Returns:
        The frames that the driver has sent on its first bus in these cycles.
    """
    sent_count = len(WIRES[0].sent)
    for _ in range(ticks):
        loop.lifecycle = lifecycle
        loop.run(1)
    return WIRES[0].sent[sent_count:]
