"""Injected faults of a bus: imitated at one end of a virtual bus, or made on an interface of the kernel.

A virtual bus behaves like an interface of the kernel with the same fault: in the errors that it reports, and in the
frames that it accepts and receives.
"""

import contextlib
import socket
import struct
import subprocess
from enum import Enum, auto

from snakesim_can_backend.bus.bus_errors import BusError, Kind
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import ConfigError

VIRTUAL = "vcan"
IP_TIMEOUT_S = 5.0

# Bits of an error frame's id: linux/can.h and linux/can/error.h.
ERROR_FRAME = 0x20000000
CONTROLLER = 0x04
BUS_OFF = 0x40
RESTARTED = 0x100
# Its second byte, if its class is CONTROLLER.
RECEIVE_OVERFLOW = 0x01
TRANSMIT_PASSIVE = 0x20
# Transmit errors that its seventh byte counts.
PASSIVE_ERRORS = 128
MAX_ERRORS = 255

# (fault, begins): class, state of the controller, transmit errors
ERROR_FRAMES = {
    ("bus_off", True): (BUS_OFF, 0, MAX_ERRORS),
    ("bus_off", False): (RESTARTED, 0, 0),
    ("error_passive", True): (CONTROLLER, TRANSMIT_PASSIVE, PASSIVE_ERRORS),
    ("overflow", True): (CONTROLLER, RECEIVE_OVERFLOW, 0),
}

# (fault, begins): kind and detail of the error that an interface of the kernel would report
REPORTED_ERRORS: dict[tuple[str, bool], tuple[Kind, str]] = {
    ("cut", True): ("interface_down", "the interface is down"),
    ("cut", False): ("interface_up", "the interface is up again"),
    ("bus_off", True): ("bus_off", f"transmit errors {MAX_ERRORS}, receive errors 0"),
    ("bus_off", False): ("restarted", "transmit errors 0, receive errors 0"),
    ("error_passive", True): (
        "error_passive",
        f"transmit errors {PASSIVE_ERRORS}, receive errors 0",
    ),
}


class SendOutcome(Enum):
    """What becomes of a frame that is sent on a bus with injected faults."""

    SENT = auto()
    REJECTED = auto()
    LOST = auto()  # accepted, but never on the bus


class VirtualFaults:
    """The injected faults of one end of a virtual bus."""

    def __init__(self, channel: str) -> None:
        self._channel = channel
        self._errors: list[BusError] = []
        self.active: set[str] = set()

    def inject(self, kind: str, *, begins: bool) -> None:
        """Start or end a fault; a fault that already has, is left as it is."""
        if kind != "error_passive":  # which is reported once, and has no end
            is_active = kind in self.active
            if begins == is_active:
                return
            if begins:
                self.active.add(kind)
            else:
                self.active.discard(kind)
        if (kind, begins) in REPORTED_ERRORS:
            error_kind, detail = REPORTED_ERRORS[kind, begins]
            self._errors.append(BusError(error_kind, self._channel, detail))

    def simulate_send(self) -> SendOutcome:
        """Return what becomes of a frame that is sent now."""
        if "cut" in self.active:
            return SendOutcome.REJECTED
        # Its queue is gone with the carrier: the kernel accepts frames and drops them.
        if "bus_off" in self.active:
            return SendOutcome.LOST
        if "full" in self.active:
            self._errors.append(BusError("queue_full", self._channel, "the transmit queue is full"))
            return SendOutcome.REJECTED
        return SendOutcome.SENT

    def filter_received(self, frames: list[CanFrame]) -> list[CanFrame]:
        """Return those of the frames on the bus that this end receives."""
        if "cut" in self.active or "bus_off" in self.active:
            return []
        if frames and "overflow" in self.active:
            self.active.discard("overflow")
            detail = f"the kernel dropped {len(frames)} frames: this process reads too slowly"
            self._errors.append(BusError("receive_overflow", self._channel, detail))
            return []
        return frames

    def pop_errors(self) -> list[BusError]:
        """Return the bus errors since the last call."""
        errors = self._errors
        self._errors = []
        return errors


def inject_into_interface(channel: str, kind: str, *, begins: bool) -> None:
    """Start or end a fault of an interface of the kernel. Raises ConfigError if that is not possible."""
    if kind == "cut":
        _set_link(channel, "down" if begins else "up")
    elif (kind, begins) in ERROR_FRAMES:
        _send_error_frame(channel, *ERROR_FRAMES[kind, begins])
    elif kind == "full":
        raise ConfigError(
            f"{channel}: a program cannot fill an interface's queue and release it again; a traffic limit does: "
            f"`tc qdisc add dev {channel} root tbf rate 8bit burst 16 limit 32`, and `tc qdisc del dev {channel} root`",
            code="injection/not-supported",
        )


def _set_link(channel: str, state: str) -> None:
    """Bring an interface up or down. Raises ConfigError."""
    command = ["ip", "link", "set", channel, state]
    problem = ""
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=IP_TIMEOUT_S, check=False
        )
        if result.returncode:
            problem = result.stderr.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        problem = str(error)
    if problem:
        raise ConfigError(
            f"`{' '.join(command)}`: {problem}; it needs CAP_NET_ADMIN, and iproute2 installed",
            code="machine/not-permitted",
        )


def _send_error_frame(
    channel: str, error_class: int, controller_state: int, transmit_errors: int
) -> None:
    """Send an error frame as the driver of a controller does. Only virtual interfaces carry one from a program."""
    if not channel.startswith(VIRTUAL):
        raise ConfigError(
            f"{channel}: error frames can only be sent on virtual interfaces, called {VIRTUAL}...",
            code="injection/not-supported",
        )
    data = bytes([0, controller_state, 0, 0, 0, 0, transmit_errors, 0])
    frame = struct.pack("=IB3x8s", ERROR_FRAME | error_class, len(data), data)
    with contextlib.closing(
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    ) as sender:
        try:
            sender.bind((channel,))
            sender.send(frame)
        except OSError as error:
            raise ConfigError(
                f"{channel}: cannot send an error frame: {error.strerror}",
                code="injection/not-supported",
            ) from error
