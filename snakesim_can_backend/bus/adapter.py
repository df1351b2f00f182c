"""A bus through any adapter that python-can opens, and which of the wires a channel is.

A channel is a SocketCAN interface (`can0`), or `INTERFACE:CHANNEL` of python-can: `slcan:/dev/ttyACM0`,
`pcan:PCAN_USBBUS1`, `kvaser:0`, `gs_usb:0`, `udp_multicast:239.74.163.2`. Its adapter is configured to the bit rate; a
kernel interface has that of `ip link`. A bus of CAN FD has a second bit rate, for data, and frames of up to 64 bytes
with ids of 11 or 29 bits.
"""

import contextlib
import math
import os
import socket
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import can

from snakesim_can_backend.bus.bus import IO_ERRORS, MAX_AT_ONCE, SocketCanWire, Wire, check_interface, to_python_can
from snakesim_can_backend.bus.bus_errors import BusError, decode_error_frame
from snakesim_can_backend.bus.load import BIT_RATE
from snakesim_can_backend.protocol.definitions import NODE_BITS, Frame, Opcode
from snakesim_hal.base.errors import BackendError, ConfigError, did_you_mean

LOCAL = ("udp_multicast", "virtual")  # interfaces without an adapter, and without a bit rate
FD = ("socketcan", "kvaser", *LOCAL)
GROUPS_ARE_SEPARATE = sys.platform == "linux"
IP_MULTICAST_ALL, IPV6_MULTICAST_ALL = 49, 29  # linux/in.h, linux/in6.h
# A library that is missing or too old makes python-can's interfaces raise any of these.
LIBRARY_ERRORS = (ImportError, TypeError, NameError, AttributeError, NotImplementedError)
SERIAL_PORT = "a serial port, such as /dev/ttyACM0: see `snakesim doctor`"
OF_KERNEL = "with the kernel's own driver the adapter is an interface such as can0"
WINDOWS = "Windows, and its vendor's driver"
NEEDS = {
    "canalystii": "the Python package canalystii",
    "cantact": "the Python package cantact",
    "etas": WINDOWS,
    "gs_usb": f"the Python packages gs_usb and pyusb; {OF_KERNEL}",
    "iscan": WINDOWS,
    "ixxat": WINDOWS,
    "kvaser": f"Kvaser's library canlib; {OF_KERNEL}",
    "neousys": "the library of Neousys, libwdt_dio",
    "neovi": "the Python packages python-ics and filelock",
    "nican": WINDOWS,
    "nixnet": WINDOWS,
    "pcan": f"PEAK's library PCANBasic; {OF_KERNEL}",
    "robotell": SERIAL_PORT,
    "seeedstudio": SERIAL_PORT,
    "serial": SERIAL_PORT,
    "slcan": SERIAL_PORT,
    "socketcan": "an interface of the kernel, such as can0",
    "socketcand": "a host and a port, which a channel cannot say; use another interface",
    "systec": WINDOWS,
    "usb2can": WINDOWS,
    "vector": WINDOWS,
}
POLL_S = 0.0005  # of an adapter that cannot be waited for


def open_wire(
    channel: str, only: Iterable[Opcode] | None = None, bit_rate: int = BIT_RATE, data_bit_rate: int | None = None
) -> Wire:
    """The end of a bus. only: messages to receive; None: all. Raises ConfigError and BackendError.

    data_bit_rate: of CAN FD; None: classic CAN.
    """
    interface, name = _parted(channel)
    if interface == "socketcan" and data_bit_rate is None:
        return SocketCanWire(name, only)
    return AdapterWire(channel, only, bit_rate, data_bit_rate)


def check_channel(channel: str, *, fd: bool = False) -> None:
    """Raise ConfigError unless python-can knows the interface, and the kernel the one that it is to have."""
    interface, name = _parted(channel)
    if fd and interface not in FD:
        raise ConfigError(
            f"channel {channel!r}: CAN FD is driven through {', '.join(FD)}; on Linux most adapters are interfaces of "
            f"the kernel, such as can0"
        )
    if interface == "socketcan":
        check_interface(name)


def check_channels(channels: Sequence[str], *, fd: bool = False) -> None:
    """Check every channel of a robot, and that each is another bus. Raises ConfigError."""
    first: dict[tuple[str, str], str] = {}
    for channel in channels:
        check_channel(channel, fd=fd)
        bus = _parted(channel)
        if bus in first:
            raise ConfigError(f"channels: {first[bus]!r} and {channel!r} are the same bus; name each bus once")
        first[bus] = channel
    groups = [channel for channel in channels if _parted(channel)[0] == "udp_multicast"]
    if len(groups) > 1 and not GROUPS_ARE_SEPARATE:
        raise ConfigError(
            f"channels: {', '.join(groups)} share one UDP port, and only Linux keeps their groups apart: name one of "
            f"them"
        )


def is_emulated(channel: str) -> bool:
    """Whether no real module can be on a bus of this name."""
    interface, name = _parted(channel)
    return interface in LOCAL or (interface == "socketcan" and name.startswith("vcan"))


def _parted(channel: str) -> tuple[str, str]:
    interface, colon, name = channel.partition(":")
    if not colon:
        return "socketcan", channel
    if interface not in can.VALID_INTERFACES:
        known = sorted(can.VALID_INTERFACES)
        raise ConfigError(
            f"channel {channel!r}: python-can has no interface {interface!r}; {did_you_mean(interface, known)}it has "
            f"{', '.join(known)}"
        )
    if not name:
        raise ConfigError(f"channel {channel!r}: give INTERFACE:CHANNEL, such as slcan:/dev/ttyACM0")
    return interface, name


def open_bus(channel: str, bit_rate: int, data_bit_rate: int | None = None) -> can.BusABC:
    """python-can's bus of a channel. Raises BackendError when it cannot be opened."""
    interface, name = _parted(channel)
    fd = data_bit_rate is not None
    settings: dict[str, Any] = {} if interface in (*LOCAL, "socketcan") else {"bitrate": bit_rate}
    if interface == "virtual":
        settings["protocol"] = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
    elif fd or interface == "udp_multicast":
        settings["fd"] = fd
    if fd and "bitrate" in settings:
        settings["data_bitrate"] = data_bit_rate
    try:
        bus = can.Bus(interface=interface, channel=name, **settings)
    except (*IO_ERRORS, *LIBRARY_ERRORS) as error:
        needs = f"; {interface} needs {NEEDS[interface]}" if interface in NEEDS else ""
        why = "its library is missing" if isinstance(error, NameError | AttributeError) else str(error)
        raise BackendError(f"{channel}: cannot be opened: {why}{needs}") from error
    if interface == "udp_multicast":
        hear_own_group(bus)
    return bus


def hear_own_group(bus: can.BusABC) -> None:
    """Receive what is sent to the group of this bus, and to no other one.

    All such buses share one port. By default the kernel gives a socket the datagrams of every group that any socket of
    the computer has joined.
    """
    with socket.socket(fileno=os.dup(bus.fileno())) as own:
        if own.family == socket.AF_INET:
            level, option = socket.IPPROTO_IP, IP_MULTICAST_ALL
        else:
            level, option = socket.IPPROTO_IPV6, IPV6_MULTICAST_ALL
        with contextlib.suppress(OSError):  # not on Linux: `check_channels` refuses a second bus
            own.setsockopt(level, option, 0)


class AdapterWire:
    """One end of a bus, through python-can. On classic CAN frames that are no data frames of 11 bits are dropped."""

    def __init__(
        self, channel: str, only: Iterable[Opcode] | None, bit_rate: int, data_bit_rate: int | None = None
    ) -> None:
        """Raises BackendError when it cannot be opened."""
        self.channel, self._fd = channel, data_bit_rate is not None
        self._only = None if only is None else frozenset(int(opcode) for opcode in only)
        self._bus = open_bus(channel, bit_rate, data_bit_rate)
        self._file = self._descriptor()
        echoed = _parted(channel)[0] == "udp_multicast"
        self._echoes: Counter[Frame] | None = Counter() if echoed else None  # of own frames
        self._found: list[BusError] = []

    def send(self, frame: Frame) -> bool:
        """Send a frame; False when the adapter did not take it."""
        try:
            self._bus.send(to_python_can(frame, fd=self._fd), timeout=0)
        except can.CanError as error:
            self._found.append(BusError("not_sent", self.channel, str(error)))
            return False
        except (OSError, ValueError) as error:
            raise BackendError(f"{self.channel}: cannot send: {error}") from error
        if self._echoes is not None:
            self._echoes[frame] += 1
        return True

    def receive(self) -> list[Frame]:
        """All received frames."""
        frames: list[Frame] = []
        try:
            for _ in range(MAX_AT_ONCE):
                if (message := self._bus.recv(0)) is None:
                    break
                if message.is_error_frame:
                    self._found += self._errors_in(message)
                elif self._is_wanted(message, frame := Frame(message.arbitration_id, bytes(message.data))):
                    frames.append(frame)
        except IO_ERRORS as error:
            raise BackendError(f"{self.channel}: cannot receive: {error}") from error
        return frames

    def errors(self) -> list[BusError]:
        """Error frames, and frames that were not sent, since the last call."""
        found, self._found = self._found, []
        return found

    def fileno(self) -> int | None:
        """Its file, where it has one."""
        return self._file

    def idle(self) -> float | None:
        """The other end runs by itself."""
        return math.inf if self._file is not None else POLL_S

    def inject(self, kind: str, *, begins: bool) -> None:
        """Nothing can be injected from this end."""
        raise ConfigError(f"{self.channel}: the fault {kind} can be injected on a virtual bus or on vcan, not here")

    def close(self) -> None:
        """Close the adapter."""
        try:
            self._bus.shutdown()
        except IO_ERRORS as error:
            raise BackendError(f"{self.channel}: cannot be closed: {error}") from error

    def _errors_in(self, message: can.Message) -> list[BusError]:
        if _parted(self.channel)[0] == "socketcan":
            return decode_error_frame(message.arbitration_id, bytes(message.data).ljust(8, b"\0"), self.channel)
        return [BusError("error_frames", self.channel, "an error frame")]

    def _is_wanted(self, message: can.Message, frame: Frame) -> bool:
        if message.is_remote_frame or (not self._fd and (message.is_extended_id or message.is_fd)):
            return False
        if self._echoes and self._echoes[frame] > 0:  # UDP returns what one sends, and does not say whose it was
            self._echoes[frame] -= 1
            return False
        return self._only is None or message.arbitration_id >> NODE_BITS in self._only

    def _descriptor(self) -> int | None:
        try:
            number = self._bus.fileno()
        except NotImplementedError:
            return None
        return number if number >= 0 else None
