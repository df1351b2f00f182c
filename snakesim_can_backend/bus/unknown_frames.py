"""Listen to a bus without sending anything: which frames on it are none of the joint modules' protocol, and whose.

Only what a frame itself shows is told: where several devices use a format, it is "as of" the one named.
"""

import time
from collections import Counter
from dataclasses import dataclass

import can

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    LAST_NODE,
    WITH_CHECKSUM,
    Frame,
    Opcode,
    has_valid_checksum,
    parse_node,
    parse_opcode,
)
from snakesim_hal.base.errors import BackendError

CANOPEN_HEARTBEAT, CANOPEN_STATES = 0x700, {0: "boot", 4: "stopped", 5: "operational", 127: "pre-operational"}
ODRIVE_HEARTBEAT, ODRIVE_LENGTH, ODRIVE_STATES, ODRIVE_NODE_BITS = 0x01, 8, 14, 5
MAX_FRAMES = 100_000


@dataclass(frozen=True)
class UnknownFrames:
    """Frames of one id that are not of our protocol."""

    id: int
    extended: bool
    length: int  # bytes, of the newest
    frames: int
    origin: str  # whose it may be; empty: unknown

    def __str__(self) -> str:
        digits = f"0x{self.id:08X}" if self.extended else f"0x{self.id:03X}"
        return f"{digits}  {self.length} B  {self.frames} frames  {self.origin or 'unknown'}"


def listen_for_unknown_frames(bus: can.BusABC, seconds: float) -> list[UnknownFrames]:
    """Those heard on a bus within a time, by id. Raises BackendError."""
    heard: Counter[tuple[int, bool]] = Counter()
    newest: dict[tuple[int, bool], can.Message] = {}
    end = time.monotonic() + seconds
    try:
        while (left_s := end - time.monotonic()) > 0 and heard.total() < MAX_FRAMES:
            message = bus.recv(left_s)
            if message is None or message.is_error_frame or matches_protocol(message):
                continue
            key = message.arbitration_id, message.is_extended_id
            heard[key] += 1
            newest[key] = message
    except (OSError, ValueError, can.CanError) as error:
        raise BackendError(f"{bus.channel_info}: cannot be listened to: {error}") from error
    return [
        UnknownFrames(*key, len(newest[key].data), count, guess_origin(newest[key]))
        for key, count in sorted(heard.items())
    ]


def matches_protocol(message: can.Message) -> bool:
    """Whether a frame has an id, a length and, where there is one, a checksum of the joint modules' protocol."""
    if message.is_extended_id or message.is_remote_frame or message.is_fd:
        return False
    frame = Frame(message.arbitration_id, bytes(message.data))
    opcode, layouts = parse_opcode(frame.id), load_layouts()
    if opcode not in layouts or parse_node(frame.id) > LAST_NODE or len(frame.data) != layouts[Opcode(opcode)].length:
        return False
    return opcode not in WITH_CHECKSUM or has_valid_checksum(frame)


def guess_origin(message: can.Message) -> str:
    """What a foreign frame looks like; empty: unknown."""
    identifier, data = message.arbitration_id, bytes(message.data)
    if message.is_fd:
        return "CAN FD"
    if message.is_extended_id:
        return "29-bit id"
    node = identifier - CANOPEN_HEARTBEAT
    if 0 < node <= 0x7F and len(data) == 1 and data[0] in CANOPEN_STATES:
        return f"as CANopen's heartbeat of node {node}, {CANOPEN_STATES[data[0]]}"
    is_heartbeat = identifier & ((1 << ODRIVE_NODE_BITS) - 1) == ODRIVE_HEARTBEAT and len(data) == ODRIVE_LENGTH
    if is_heartbeat and data[4] <= ODRIVE_STATES:
        return f"as ODrive's heartbeat of node {identifier >> ODRIVE_NODE_BITS}"
    return ""
