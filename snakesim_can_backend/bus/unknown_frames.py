"""Listens to a bus without sending anything, and lists the frames that are none of the joint modules' protocol.

The origin of such a frame is guessed from its id, length and data only. Where several devices use a format, the guess
is "as" the one that is named.
"""

import time
from collections import Counter, deque
from dataclasses import dataclass

import can

from snakesim_can_backend.bus.bus import to_python_can, wait
from snakesim_can_backend.bus.local_wire import MAX_CLASSIC_BYTES, LocalWire
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    LAST_NODE,
    WITH_CHECKSUM,
    CanFrame,
    Opcode,
    has_valid_checksum,
    parse_node,
    parse_opcode,
)
from snakesim_hal.base.errors import BackendError

MAX_FRAMES = 100_000  # then listening ends early

# CANopen: a heartbeat has the id 0x700 + node, and one byte with the node's state.
CANOPEN_HEARTBEAT = 0x700
CANOPEN_MAX_NODE = 0x7F
CANOPEN_STATES = {0: "boot", 4: "stopped", 5: "operational", 127: "pre-operational"}

# ODrive: a heartbeat has the command 0x01 in the lower five bits of its id, and the axis state in its fifth byte.
ODRIVE_HEARTBEAT = 0x01
ODRIVE_HEARTBEAT_BYTES = 8
ODRIVE_STATE_BYTE = 4
ODRIVE_MAX_STATE = 14
ODRIVE_COMMAND_BITS = 5


@dataclass(frozen=True)
class UnknownFrames:
    """Frames of one id that are not of the joint modules' protocol."""

    id: int
    extended: bool
    length: int  # bytes, of the newest
    frames: int
    origin: str  # device that may have sent them; empty: unknown

    def __str__(self) -> str:
        digits = f"0x{self.id:08X}" if self.extended else f"0x{self.id:03X}"
        return f"{digits}  {self.length} B  {self.frames} frames  {self.origin or 'unknown'}"


class LocalBusReader:
    """Reads an open local bus as python-can reads the other buses."""

    def __init__(self, wire: LocalWire) -> None:
        """Begin to read.

        Args:
            wire: Open end of the bus, for CAN FD, so that it receives all frames.
        """
        self.channel_info = wire.channel
        self._wire = wire
        self._frames: deque[CanFrame] = deque()

    def recv(self, timeout: float) -> can.Message | None:
        """Return the next frame; None if there is none within the timeout in s."""
        if not self._frames:
            wait([self._wire], timeout)
            self._frames.extend(self._wire.receive())
        if not self._frames:
            return None
        frame = self._frames.popleft()
        return to_python_can(frame, fd=len(frame.data) > MAX_CLASSIC_BYTES)


def listen_for_unknown_frames(
    bus: can.BusABC | LocalBusReader, duration_s: float
) -> list[UnknownFrames]:
    """Collect the frames on a bus that do not belong to the protocol of joint modules, without sending anything.

    Args:
        bus: An open bus.
        duration_s: How long to listen; it ends earlier after MAX_FRAMES frames.

    Returns:
        The unknown frames by id, with their number and a guess at their origin.

    Raises:
        BackendError: The bus cannot be read.
    """
    frame_count_by_key: Counter[tuple[int, bool]] = Counter()  # by id, and whether it is extended
    newest_message_by_key: dict[tuple[int, bool], can.Message] = {}
    deadline_s = time.monotonic() + duration_s
    try:
        while frame_count_by_key.total() < MAX_FRAMES:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0:
                break
            message = bus.recv(remaining_s)
            if message is None or message.is_error_frame or is_joint_module_frame(message):
                continue
            key = message.arbitration_id, message.is_extended_id
            frame_count_by_key[key] += 1
            newest_message_by_key[key] = message
    except (OSError, ValueError, can.CanError) as error:
        raise BackendError(
            f"{bus.channel_info}: cannot be listened to: {error}", code="bus/io-failed"
        ) from error
    unknown: list[UnknownFrames] = []
    for (identifier, extended), count in sorted(frame_count_by_key.items()):
        message = newest_message_by_key[identifier, extended]
        unknown.append(
            UnknownFrames(
                identifier, extended, len(message.data), count, guess_frame_origin(message)
            )
        )
    return unknown


def is_joint_module_frame(message: can.Message) -> bool:
    """Return whether id, length and, where there is one, checksum are those of the joint modules' protocol."""
    if message.is_extended_id or message.is_remote_frame or message.is_fd:
        return False
    frame = CanFrame(message.arbitration_id, bytes(message.data))
    opcode = parse_opcode(frame.id)
    layouts = load_layouts()
    if opcode not in layouts or parse_node(frame.id) > LAST_NODE:
        return False
    if len(frame.data) != layouts[Opcode(opcode)].length:
        return False
    return opcode not in WITH_CHECKSUM or has_valid_checksum(frame)


def guess_frame_origin(message: can.Message) -> str:
    """Return a guess at what has sent an unknown frame, such as "29-bit id"; empty if it is unknown."""
    identifier = message.arbitration_id
    data = bytes(message.data)
    if message.is_fd:
        return "CAN FD"
    if message.is_extended_id:
        return "29-bit id"
    node = identifier - CANOPEN_HEARTBEAT
    if 0 < node <= CANOPEN_MAX_NODE and len(data) == 1 and data[0] in CANOPEN_STATES:
        return f"as CANopen's heartbeat of node {node}, {CANOPEN_STATES[data[0]]}"
    command = identifier & ((1 << ODRIVE_COMMAND_BITS) - 1)
    is_heartbeat = command == ODRIVE_HEARTBEAT and len(data) == ODRIVE_HEARTBEAT_BYTES
    if is_heartbeat and data[ODRIVE_STATE_BYTE] <= ODRIVE_MAX_STATE:
        return f"as ODrive's heartbeat of node {identifier >> ODRIVE_COMMAND_BITS}"
    return ""
