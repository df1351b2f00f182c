"""Bus errors, and how to read them from the kernel's error frames."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "bus_off",
    "error_passive",
    "error_warning",
    "not_acknowledged",
    "restarted",
    "interface_down",
    "interface_up",
    "queue_full",
    "not_sent",
    "receive_overflow",
    "error_frames",
]

# Bits of an error frame's id, and of its second byte: linux/can/error.h.
ERROR_CLASSES: tuple[tuple[int, Kind], ...] = (
    (0x40, "bus_off"),
    (0x20, "not_acknowledged"),
    (0x100, "restarted"),
)
CONTROLLER_CLASS = 0x04  # the second byte has the controller's state
CONTROLLER_STATES: tuple[tuple[int, Kind], ...] = (
    (0x30, "error_passive"),
    (0x0C, "error_warning"),
    (0x01, "receive_overflow"),
)
OTHER_ERROR: Kind = "error_frames"

# What a person can do about the errors that are faults of the robot.
BUS_FAULTS = {
    "bus_off": "the controller has left the bus after too many errors: look for a short, a wrong bit rate, a missing "
    "terminator; bring the interface down and up again, then reset and arm",
    "error_passive": "more than 127 errors: the bus is about to fail; look at cables, terminators and bit rate",
    "interface_down": "nothing is sent or received; bring it up again, then reset and arm",
    "restarted": "the controller has restarted after bus-off; reset and arm when the bus is in order",
    "receive_overflow": "states may be missing",
}


@dataclass(frozen=True)
class BusError:
    """An error of a bus, not of a module on it."""

    kind: Kind
    channel: str
    detail: str


def decode_error_frame(identifier: int, data: bytes, channel: str) -> list[BusError]:
    """Return the bus errors in an error frame of the kernel.

    Args:
        identifier: Id of the frame, with the bits of its error classes.
        data: All 8 bytes of the frame: the controller's state in the second, error counters in the last two.
        channel: The bus that the frame came from.
    """
    kinds: list[Kind] = [kind for bit, kind in ERROR_CLASSES if identifier & bit]
    if identifier & CONTROLLER_CLASS:
        controller_state = data[1]
        states: list[Kind] = [kind for bits, kind in CONTROLLER_STATES if controller_state & bits]
        kinds.extend(states)
    if not kinds:
        kinds.append(OTHER_ERROR)
    counters = f"transmit errors {data[6]}, receive errors {data[7]}"
    return [BusError(kind, channel, counters) for kind in kinds]
