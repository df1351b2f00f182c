"""Injected faults of a bus: imitated at one end of a virtual bus, and made on a kernel interface.

A virtual bus behaves like a kernel interface with the same fault: its errors, accepted frames and received frames.
"""

import contextlib
import socket
import struct
import subprocess

from snakesim_can_backend.bus.bus_errors import BusError, Kind
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.base.errors import ConfigError

VIRTUAL = "vcan"
ERROR_FRAME, CONTROLLER, BUS_OFF, RESTARTED = 0x20000000, 0x04, 0x40, 0x100  # linux/can.h, linux/can/error.h
RECEIVE_OVERFLOW, TRANSMIT_PASSIVE = 0x01, 0x20  # in data[1] of the class `CONTROLLER`
PASSIVE_ERRORS, MAX_ERRORS = 128, 255
ERROR_FRAMES = {  # fault, begins -> class, state of the controller, transmit errors
    ("bus_off", True): (BUS_OFF, 0, MAX_ERRORS),
    ("bus_off", False): (RESTARTED, 0, 0),
    ("error_passive", True): (CONTROLLER, TRANSMIT_PASSIVE, PASSIVE_ERRORS),
    ("overflow", True): (CONTROLLER, RECEIVE_OVERFLOW, 0),
}


SEEN: dict[tuple[str, bool], tuple[Kind, str]] = {  # fault, begins -> the error that a kernel interface would tell
    ("cut", True): ("interface_down", "the interface is down"),
    ("cut", False): ("interface_up", "the interface is up again"),
    ("bus_off", True): ("bus_off", f"transmit errors {MAX_ERRORS}, receive errors 0"),
    ("bus_off", False): ("restarted", "transmit errors 0, receive errors 0"),
    ("error_passive", True): ("error_passive", f"transmit errors {PASSIVE_ERRORS}, receive errors 0"),
}


class VirtualFaults:
    """Injected faults of one end of a virtual bus."""

    def __init__(self, channel: str) -> None:
        self._channel = channel
        self._found: list[BusError] = []
        self.on: set[str] = set()

    def inject(self, kind: str, *, begins: bool) -> None:
        """Begin or end one."""
        if kind != "error_passive":  # which has no end
            if begins == (kind in self.on):
                return
            self.on.symmetric_difference_update([kind])
        if seen := SEEN.get((kind, begins)):
            self._found.append(BusError(seen[0], self._channel, seen[1]))

    def stops_sending(self) -> bool | None:
        """What happens to a frame: False, rejected; True, accepted and lost; None, sent."""
        if "cut" in self.on:
            return False
        if "bus_off" in self.on:  # its queue is gone with the carrier: the kernel accepts frames and drops them
            return True
        if "full" in self.on:
            self._found.append(BusError("queue_full", self._channel, "the transmit queue is full"))
            return False
        return None

    def leaves(self, frames: list[Frame]) -> list[Frame]:
        """The sent frames that arrive."""
        if self.on & {"cut", "bus_off"}:
            return []
        if frames and "overflow" in self.on:
            self.on.discard("overflow")
            detail = f"the kernel dropped {len(frames)} frames: this process reads too slowly"
            self._found.append(BusError("receive_overflow", self._channel, detail))
            return []
        return frames

    def take_errors(self) -> list[BusError]:
        """Bus errors since the last call."""
        found, self._found = self._found, []
        return found


def inject_into_interface(channel: str, kind: str, *, begins: bool) -> None:
    """Begin or end a fault of a kernel interface. Raises ConfigError if that is not possible."""
    if kind == "cut":
        _set_link(channel, "down" if begins else "up")
    elif (kind, begins) in ERROR_FRAMES:
        _send_error(channel, *ERROR_FRAMES[kind, begins])
    elif kind == "full":
        raise ConfigError(
            f"{channel}: a program cannot fill an interface's queue and release it again; a traffic limit does: "
            f"`tc qdisc add dev {channel} root tbf rate 8bit burst 16 limit 32`, and `tc qdisc del dev {channel} root`"
        )


def _set_link(channel: str, state: str) -> None:
    command = ["ip", "link", "set", channel, state]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=False)
        said = done.stderr.strip() if done.returncode else ""
    except (OSError, subprocess.TimeoutExpired) as error:
        said = str(error)
    if said:
        raise ConfigError(f"`{' '.join(command)}`: {said}; it needs CAP_NET_ADMIN, and iproute2 installed")


def _send_error(channel: str, kind: int, controller: int, transmit_errors: int) -> None:
    """As the driver of a controller would: only virtual interfaces carry error frames sent by a program."""
    if not channel.startswith(VIRTUAL):
        raise ConfigError(f"{channel}: error frames can only be sent on virtual interfaces, called {VIRTUAL}...")
    data = bytes([0, controller, 0, 0, 0, 0, transmit_errors, 0])
    with contextlib.closing(socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)) as other:
        try:
            other.bind((channel,))
            other.send(struct.pack("=IB3x8s", ERROR_FRAME | kind, len(data), data))
        except OSError as error:
            raise ConfigError(f"{channel}: cannot send an error frame: {error.strerror}") from error
