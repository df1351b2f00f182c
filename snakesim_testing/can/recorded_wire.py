"""A driver on a bus that keeps what went over it, and what its modules are doing."""

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
from snakesim_testing.can.driver_loop import DriverLoop, chain_of
from snakesim_testing.can.frames import read

ARMED, DISARMED, EMERGENCY = ModuleState.ARMED, ModuleState.DISARMED, ModuleState.EMERGENCY
Which = Callable[[CanFrame], bool]


def none(_frame: CanFrame) -> bool:
    return False


class RecordedWire(VirtualWire):
    """A virtual bus that records its frames. It refuses or loses the frames that a test selects."""

    def __init__(self, channel: str, peer: VirtualPeer | None = None) -> None:
        super().__init__(channel, peer)
        self.sent: list[CanFrame] = []
        self.all: list[CanFrame] = []
        self.refuses: Which = none
        self.loses: Which = none
        self.deaf_to: Which = none
        self.closed = 0
        WIRES.append(self)

    def send(self, frame: CanFrame) -> bool:
        if self.refuses(frame):
            return False
        self.sent.append(frame)
        self.all.append(frame)
        return self.loses(frame) or super().send(frame)

    def receive(self) -> list[CanFrame]:
        frames = [frame for frame in super().receive() if not self.deaf_to(frame)]
        self.all += frames
        return frames

    def close(self) -> None:
        self.closed += 1
        super().close()


WIRES: list[RecordedWire] = []


def is_action(frame: CanFrame, *actions: CommandAction) -> bool:
    return parse_opcode(frame.id) == Opcode.COMMAND and read(frame)["action"] in actions


def is_setpoint(frame: CanFrame) -> bool:
    return parse_opcode(frame.id) == Opcode.SET_POINT


def words(frames: list[CanFrame]) -> list[str]:
    """The frames of the host other than Syncs and setpoints, as text."""
    found = []
    for frame in frames:
        opcode = Opcode(parse_opcode(frame.id))
        if opcode == Opcode.COMMAND:
            who = "" if parse_node(frame.id) == BROADCAST else f" {parse_node(frame.id)}"
            found.append(CommandAction(int(read(frame)["action"])).name.lower() + who)
        elif opcode == Opcode.EMERGENCY:
            found.append("emergency")
    return found


def module_of(run: DriverLoop, node_id: int) -> ModuleFirmware:
    return chain_of(run.backend).slots[node_id - 1].module


def go(run: DriverLoop, lifecycle: LifecycleState, ticks: int = 1) -> list[CanFrame]:
    """So many ticks in a state, whatever is found; what was sent meanwhile."""
    before = len(WIRES[0].sent)
    for _ in range(ticks):
        run.lifecycle = lifecycle
        run.run(1)
    return WIRES[0].sent[before:]
