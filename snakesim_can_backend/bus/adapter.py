"""Opens a bus through any adapter that python-can supports, and parses the name of a channel.

A channel is a SocketCAN interface (`can0`), or `INTERFACE:CHANNEL` of python-can: `slcan:/dev/ttyACM0`,
`pcan:PCAN_USBBUS1`, `kvaser:0`, `gs_usb:0`, `udp_multicast:239.74.163.2`. Its adapter is configured to the bit rate; a
kernel interface has that of `ip link`. A bus of CAN FD has a second bit rate, for data, and frames of up to 64 bytes
with ids of 11 or 29 bits. `local:FOLDER` needs no adapter: it is a bus of emulated drives between processes.
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

from snakesim_can_backend.bus.bus import (
    IO_ERRORS,
    MAX_AT_ONCE,
    SocketCanWire,
    Wire,
    to_python_can,
    validate_interface,
)
from snakesim_can_backend.bus.bus_errors import BusError, decode_error_frame
from snakesim_can_backend.bus.load import BIT_RATE
from snakesim_can_backend.bus.local_wire import LOCAL, LocalWire, validate_local_bus
from snakesim_can_backend.protocol.definitions import NODE_BITS, CanFrame, Opcode
from snakesim_hal.base.errors import BackendError, ConfigError, suggest_word

# All interfaces that a channel may name. Only LOCAL is implemented here.
INTERFACES = frozenset({*can.VALID_INTERFACES, LOCAL})
INTERFACES_WITHOUT_ADAPTER = "udp_multicast", "virtual", LOCAL  # they have no bit rate, either
# Interfaces through which this driver supports CAN FD.
FD_INTERFACES = "socketcan", "kvaser", "udp_multicast", "virtual", LOCAL
# Only Linux keeps multicast groups on one UDP port apart.
ARE_MULTICAST_GROUPS_SEPARATE = sys.platform == "linux"
IP_MULTICAST_ALL = 49  # linux/in.h
IPV6_MULTICAST_ALL = 29  # linux/in6.h
ERROR_FRAME_BYTES = 8  # of a whole error frame of the kernel
# A library that is missing or too old makes python-can's interfaces raise any of these.
LIBRARY_ERRORS = (ImportError, TypeError, NameError, AttributeError, NotImplementedError)
SERIAL_PORT = "a serial port, such as /dev/ttyACM0: see `snakesim doctor`"
KERNEL_DRIVER = "with the kernel's own driver the adapter is an interface such as can0"
WINDOWS = "Windows, and its vendor's driver"
# What a person must install or name to use an interface of python-can; shown when it cannot be opened.
REQUIREMENT_BY_INTERFACE = {
    "canalystii": "the Python package canalystii",
    "cantact": "the Python package cantact",
    "etas": WINDOWS,
    "gs_usb": f"the Python packages gs_usb and pyusb; {KERNEL_DRIVER}",
    "iscan": WINDOWS,
    "ixxat": WINDOWS,
    "kvaser": f"Kvaser's library canlib; {KERNEL_DRIVER}",
    "neousys": "the library of Neousys, libwdt_dio",
    "neovi": "the Python packages python-ics and filelock",
    "nican": WINDOWS,
    "nixnet": WINDOWS,
    "pcan": f"PEAK's library PCANBasic; {KERNEL_DRIVER}",
    "robotell": SERIAL_PORT,
    "seeedstudio": SERIAL_PORT,
    "serial": SERIAL_PORT,
    "slcan": SERIAL_PORT,
    "socketcan": "an interface of the kernel, such as can0",
    "socketcand": "a host and a port, which a channel cannot name; use another interface",
    "systec": WINDOWS,
    "usb2can": WINDOWS,
    "vector": WINDOWS,
}
POLL_PERIOD_S = 0.0005  # pause between two looks at an adapter that has no file descriptor


def open_wire(
    channel: str,
    received_opcodes: Iterable[Opcode] | None = None,
    bit_rate: int = BIT_RATE,
    data_bit_rate: int | None = None,
) -> Wire:
    """Open one end of a bus: a SocketCAN interface of the kernel, an adapter of python-can, or a local bus.

    Args:
        channel: SocketCAN interface such as can0, INTERFACE:CHANNEL of python-can, or local:FOLDER, which is created
            if it does not exist.
        received_opcodes: Opcodes of the messages to receive; None for all messages.
        bit_rate: Bit rate in bit/s; not used by an interface of the kernel.
        data_bit_rate: Second bit rate in bit/s, for the data of CAN FD; None for classic CAN.

    Raises:
        ConfigError: There is no such channel.
        BackendError: The channel cannot be opened.
    """
    interface, name = split_channel(channel)
    if interface == LOCAL:
        return LocalWire(name, received_opcodes, fd=data_bit_rate is not None)
    if interface == "socketcan" and data_bit_rate is None:
        return SocketCanWire(name, received_opcodes)
    return AdapterWire(channel, received_opcodes, bit_rate, data_bit_rate)


def split_channel(channel: str) -> tuple[str, str]:
    """Return python-can's interface and the name of a channel on it. Raises ConfigError."""
    interface, colon, name = channel.partition(":")
    if not colon:
        return "socketcan", channel
    if interface not in INTERFACES:
        interfaces = sorted(INTERFACES)
        raise ConfigError(
            f"channel {channel!r}: there is no interface {interface!r}; "
            f"{suggest_word(interface, interfaces)}the interfaces are {', '.join(interfaces)}",
            code="bus/invalid-channel",
        )
    if not name:
        raise ConfigError(
            f"channel {channel!r}: give INTERFACE:CHANNEL, such as slcan:/dev/ttyACM0",
            code="bus/invalid-channel",
        )
    return interface, name


def validate_channel(channel: str, *, needs_fd: bool = False, is_emulator: bool = False) -> None:
    """Check that there is the interface of a channel, and that an interface of the kernel or a local bus is in use.

    Args:
        channel: SocketCAN interface such as can0, INTERFACE:CHANNEL of python-can, or local:FOLDER.
        needs_fd: Whether the channel must support CAN FD.
        is_emulator: Whether drives will be emulated there: they may be the first program on a local bus.

    Raises:
        ConfigError: The channel does not exist, is down, does not support CAN FD, or is a local bus without a program.
    """
    interface, name = split_channel(channel)
    if needs_fd and interface not in FD_INTERFACES:
        raise ConfigError(
            f"channel {channel!r}: CAN FD is driven through {', '.join(FD_INTERFACES)}; on Linux most adapters are "
            f"interfaces of the kernel, such as can0",
            code="bus/invalid-channel",
        )
    if interface == "socketcan":
        validate_interface(name)
    if interface == LOCAL and not is_emulator:
        validate_local_bus(name)


def validate_channels(
    channels: Sequence[str], *, needs_fd: bool = False, is_emulator: bool = False
) -> None:
    """Check every channel of a robot as `validate_channel` does, and that no two of them are the same bus.

    Args:
        channels: SocketCAN interfaces, INTERFACE:CHANNEL of python-can, or local:FOLDER.
        needs_fd: Whether the channels must support CAN FD.
        is_emulator: Whether drives will be emulated there.

    Raises:
        ConfigError: A channel cannot be used, or is named twice.
    """
    channel_by_bus: dict[tuple[str, str], str] = {}
    for channel in channels:
        validate_channel(channel, needs_fd=needs_fd, is_emulator=is_emulator)
        bus = split_channel(channel)
        if bus in channel_by_bus:
            raise ConfigError(
                f"channels: {channel_by_bus[bus]!r} and {channel!r} are the same bus; name each bus once",
                code="bus/invalid-channel",
            )
        channel_by_bus[bus] = channel
    multicast_channels = [channel for channel in channels if _is_multicast(channel)]
    if len(multicast_channels) > 1 and not ARE_MULTICAST_GROUPS_SEPARATE:
        raise ConfigError(
            f"channels: {', '.join(multicast_channels)} share one UDP port, and only Linux keeps their groups apart: "
            f"name one of them",
            code="bus/invalid-channel",
        )


def is_emulated(channel: str) -> bool:
    """Return whether no real module can be on a bus of this name."""
    interface, name = split_channel(channel)
    is_virtual_interface = interface == "socketcan" and name.startswith("vcan")
    return interface in INTERFACES_WITHOUT_ADAPTER or is_virtual_interface


def _is_multicast(channel: str) -> bool:
    interface, _ = split_channel(channel)
    return interface == "udp_multicast"


def open_bus(channel: str, bit_rate: int, data_bit_rate: int | None = None) -> can.BusABC:
    """Open a channel as a bus of python-can.

    Args:
        channel: SocketCAN interface such as can0, or INTERFACE:CHANNEL of python-can.
        bit_rate: Bit rate in bit/s; not used by an interface of the kernel.
        data_bit_rate: Second bit rate in bit/s, for the data of CAN FD; None for classic CAN.

    Raises:
        ConfigError: There is no such interface.
        BackendError: The channel cannot be opened. The message names what the interface needs, if that is known.
    """
    interface, name = split_channel(channel)
    settings = _make_bus_arguments(interface, bit_rate, data_bit_rate)
    try:
        bus = can.Bus(interface=interface, channel=name, **settings)
    except (*IO_ERRORS, *LIBRARY_ERRORS) as error:
        needs = (
            f"; {interface} needs {REQUIREMENT_BY_INTERFACE[interface]}"
            if interface in REQUIREMENT_BY_INTERFACE
            else ""
        )
        is_library_missing = isinstance(error, NameError | AttributeError)
        reason = "its library is missing" if is_library_missing else str(error)
        raise BackendError(
            f"{channel}: cannot be opened: {reason}{needs}", code="bus/cannot-open"
        ) from error
    if interface == "udp_multicast":
        restrict_to_own_multicast_group(bus)
    return bus


def _make_bus_arguments(interface: str, bit_rate: int, data_bit_rate: int | None) -> dict[str, Any]:
    """Return the arguments with which python-can opens an interface; they differ between interfaces."""
    fd = data_bit_rate is not None
    if interface == "virtual":
        return {"protocol": can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20}
    if interface == "udp_multicast":
        return {"fd": fd}
    if interface == "socketcan":  # its bit rates are set with `ip link`
        return {"fd": True} if fd else {}
    settings: dict[str, Any] = {"bitrate": bit_rate}
    if fd:
        settings["fd"] = True
        settings["data_bitrate"] = data_bit_rate
    return settings


def restrict_to_own_multicast_group(bus: can.BusABC) -> None:
    """Configure the socket of a bus so that it receives the datagrams of its own multicast group only.

    All such buses share one port. By default the kernel gives a socket the datagrams of every group that any socket of
    the computer has joined.
    """
    with socket.socket(fileno=os.dup(bus.fileno())) as own_socket:
        if own_socket.family == socket.AF_INET:
            level = socket.IPPROTO_IP
            option = IP_MULTICAST_ALL
        else:
            level = socket.IPPROTO_IPV6
            option = IPV6_MULTICAST_ALL
        with contextlib.suppress(OSError):  # not on Linux: `validate_channels` rejects a second bus
            own_socket.setsockopt(level, option, 0)


class AdapterWire:
    """One end of a bus, through python-can. On classic CAN it drops all frames but data frames with 11-bit ids."""

    def __init__(
        self,
        channel: str,
        received_opcodes: Iterable[Opcode] | None,
        bit_rate: int,
        data_bit_rate: int | None = None,
    ) -> None:
        """Open the adapter.

        Args:
            channel: INTERFACE:CHANNEL of python-can.
            received_opcodes: Opcodes of the messages to receive; None for all messages.
            bit_rate: Bit rate in bit/s.
            data_bit_rate: Second bit rate in bit/s, for the data of CAN FD; None for classic CAN.

        Raises:
            ConfigError: python-can has no such interface.
            BackendError: The channel cannot be opened.
        """
        self.channel = channel
        self._uses_fd = data_bit_rate is not None
        self._received_opcodes = (
            None
            if received_opcodes is None
            else frozenset(int(opcode) for opcode in received_opcodes)
        )
        self._bus = open_bus(channel, bit_rate, data_bit_rate)
        self._descriptor = self._find_file_descriptor()
        # UDP multicast also delivers the frames that this end sends to this end. To drop these echoes, count how many
        # of each frame were sent and have not come back. None: the adapter returns no echoes.
        self._pending_echo_counts: Counter[CanFrame] | None = None
        if _is_multicast(channel):
            self._pending_echo_counts = Counter()
        self._errors: list[BusError] = []

    def send(self, frame: CanFrame) -> bool:
        """Send a frame; return False if the adapter did not accept it."""
        try:
            self._bus.send(to_python_can(frame, fd=self._uses_fd), timeout=0)
        except can.CanError as error:
            self._errors.append(BusError("not_sent", self.channel, str(error)))
            return False
        except (OSError, ValueError) as error:
            raise BackendError(
                f"{self.channel}: cannot send: {error}", code="bus/io-failed"
            ) from error
        if self._pending_echo_counts is not None:
            self._pending_echo_counts[frame] += 1
        return True

    def receive(self) -> list[CanFrame]:
        """Return all received frames, in order."""
        frames: list[CanFrame] = []
        try:
            for _ in range(MAX_AT_ONCE):
                message = self._bus.recv(0)
                if message is None:
                    break
                if message.is_error_frame:
                    self._errors += self._decode_errors(message)
                    continue
                frame = CanFrame(message.arbitration_id, bytes(message.data))
                if self._should_receive(message, frame):
                    frames.append(frame)
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot receive: {error}", code="bus/io-failed"
            ) from error
        return frames

    def errors(self) -> list[BusError]:
        """Return the error frames, and the frames that were not sent, since the last call."""
        errors = self._errors
        self._errors = []
        return errors

    def fileno(self) -> int | None:
        """Return the adapter's file descriptor, or None if it has none."""
        return self._descriptor

    def idle(self) -> float | None:
        """Return how long to wait for the file descriptor, or until the next look at an adapter without one."""
        return math.inf if self._descriptor is not None else POLL_PERIOD_S

    def inject(self, kind: str, *, begins: bool) -> None:
        """Raise ConfigError, because no fault can be injected from this end."""
        raise ConfigError(
            f"{self.channel}: the fault {kind} can be injected on a virtual bus or on vcan, not here",
            code="injection/not-supported",
        )

    def close(self) -> None:
        """Close the adapter."""
        try:
            self._bus.shutdown()
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot be closed: {error}", code="bus/io-failed"
            ) from error

    def _decode_errors(self, message: can.Message) -> list[BusError]:
        interface, _ = split_channel(self.channel)
        if interface == "socketcan":
            data = bytes(message.data).ljust(ERROR_FRAME_BYTES, b"\0")
            return decode_error_frame(message.arbitration_id, data, self.channel)
        return [BusError("error_frames", self.channel, "an error frame")]

    def _should_receive(self, message: can.Message, frame: CanFrame) -> bool:
        """Return whether to receive a frame; an echo of a frame that this end sent is removed once."""
        if message.is_remote_frame:
            return False
        if not self._uses_fd and (message.is_extended_id or message.is_fd):
            return False
        # UDP does not report which end sent a datagram.
        if self._pending_echo_counts and self._pending_echo_counts[frame] > 0:
            self._pending_echo_counts[frame] -= 1
            return False
        return (
            self._received_opcodes is None
            or message.arbitration_id >> NODE_BITS in self._received_opcodes
        )

    def _find_file_descriptor(self) -> int | None:
        try:
            number = self._bus.fileno()
        except NotImplementedError:
            return None
        return number if number >= 0 else None
