"""One end of a CAN bus: it sends and receives frames, and reports bus errors.

`SocketCanWire` is an interface of the kernel (can0, vcan0). python-can opens and filters it; frames go through its
socket directly, which costs a third of a `can.Message` each. `VirtualWire` is python-can's virtual bus between two ends
in one process, for machines whose kernel has no CAN. It does *not* simulate arbitration and bit rate. It has errors, a
full queue and an interface that is down only as injected faults: see `bus_faults`.
"""

import contextlib
import errno
import math
import select
import socket
import struct
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import can
from can.interfaces.socketcan.socketcan import SocketcanBus
from can.interfaces.virtual import VirtualBus

from snakesim_can_backend.bus.bus_errors import BusError, decode_error_frame
from snakesim_can_backend.bus.bus_faults import inject_into_interface
from snakesim_can_backend.bus.faultable_wire import FaultableWire
from snakesim_can_backend.protocol.definitions import NODE_BITS, NODE_MASK, CanFrame, Opcode
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection

# Flags in the id of a frame on a raw socket: linux/can.h.
EXTENDED = 0x80000000
REMOTE = 0x40000000
ERROR = 0x20000000
LAST_STANDARD_ID = 0x7FF  # of 11 bits
# The drop counter of a socket: linux/sock_diag.h.
SO_MEMINFO = 55
MEMINFO_FORMAT = struct.Struct("=9I")
MEMINFO_DROPS = 8  # index of the counter
INTERFACE_UP = 1  # flag of an interface: linux/if.h

RECEIVE_BUFFER_BYTES = 1 << 20  # enough for seconds in which this process does not run
MAX_AT_ONCE = 4096  # frames; a babbling bus must not block its reader for ever
MAX_WAIT_S = 0.01  # for frames, before control cycles begin
PAUSE_S = 0.001  # while nothing can arrive
IO_ERRORS = (OSError, ValueError, can.CanError)  # of sockets, of `select` and of python-can
RAW_FRAME_FORMAT = struct.Struct("<IB3x8s")  # id, length, data


class Wire(Protocol):
    """One end of a bus.

    Errors of the bus are reported by `errors`. A method may also raise a BackendError, but never another exception.
    """

    channel: str

    def send(self, frame: CanFrame) -> bool:
        """Send a frame.

        Returns:
            False if the bus did not accept the frame. `errors` has the reason, and nothing is queued for later.
        """
        ...

    def receive(self) -> list[CanFrame]:
        """Return all received frames, in order. Never waits."""
        ...

    def errors(self) -> list[BusError]:
        """Return the bus errors since the last call."""
        ...

    def fileno(self) -> int | None:
        """Return a file descriptor to wait on; None for a bus inside this process."""
        ...

    def idle(self) -> float | None:
        """Let the other end run, if it is in this process.

        Returns:
            Seconds until a frame may arrive, and 0 if there is one. None if no frame can arrive before this end sends
            something.
        """
        ...

    def inject(self, kind: str, *, begins: bool) -> None:
        """Start or end an injected bus fault: see `snakesim_hal.model.fault_kinds`. Raises ConfigError."""
        ...

    def close(self) -> None:
        """Close the bus."""
        ...


class SocketCanWire:
    """One end of a bus, as an interface of the kernel."""

    def __init__(self, channel: str, received_opcodes: Iterable[Opcode] | None = None) -> None:
        """Open a SocketCAN interface of the kernel for sending and receiving without blocking.

        Args:
            channel: Name of the interface.
            received_opcodes: Opcodes of the messages to receive, filtered in the kernel; None for all frames with
                11-bit ids.

        Raises:
            ConfigError: There is no such interface, or it is down.
            BackendError: The interface cannot be opened.
        """
        validate_interface(channel)
        self.channel = channel
        self._received_opcodes = None if received_opcodes is None else list(received_opcodes)
        try:
            self._bus = SocketcanBus(channel=channel, ignore_rx_error_frames=False)
            self._socket = self._bus.socket
            self._set_filters()
            self._socket.setblocking(False)
        except IO_ERRORS as error:
            raise BackendError(
                f"{channel}: cannot be opened: {error}", code="bus/cannot-open"
            ) from error
        # A kernel that refuses a larger buffer only drops frames earlier, and `errors` reports dropped frames.
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self._buffer = bytearray(RAW_FRAME_FORMAT.size)
        self._errors: list[BusError] = []
        self._is_down = False  # whether the interface is down
        self._is_unplugged = False  # whether the adapter of the interface was unplugged
        # Received frames that the kernel had dropped at the last call of `errors`.
        self._reported_drop_count = 0

    def send(self, frame: CanFrame) -> bool:
        """Send a frame; return False if the queue is full or the interface is down."""
        try:
            self._socket.send(RAW_FRAME_FORMAT.pack(frame.id, len(frame.data), frame.data))
        except OSError as error:
            self._record_os_error(error)
            return False
        if self._is_down:
            self._record_interface_up()
        return True

    def receive(self) -> list[CanFrame]:
        """Return all received frames, in order."""
        frames: list[CanFrame] = []
        try:
            drain_socket(self._socket, self._buffer, frames, self._record_error_frame)
        except OSError as error:
            self._record_os_error(error)
        return frames

    def errors(self) -> list[BusError]:
        """Return the bus errors since the last call, with frames that the kernel dropped."""
        dropped = self._read_drop_count()
        if dropped > self._reported_drop_count:
            detail = f"the kernel dropped {dropped - self._reported_drop_count} frames: this process reads too slowly"
            self._errors.append(BusError("receive_overflow", self.channel, detail))
            self._reported_drop_count = dropped
        if self._is_down and is_up(self.channel):
            self._record_interface_up()
        errors = self._errors
        self._errors = []
        return errors

    def fileno(self) -> int | None:
        """Return the socket's file descriptor."""
        return self._socket.fileno()

    def idle(self) -> float | None:
        """Return infinity, because a frame may arrive at any time and the socket can be waited for."""
        return math.inf

    def inject(self, kind: str, *, begins: bool) -> None:
        """Start or end a fault: the interface goes down, or an error frame reports an error."""
        inject_into_interface(self.channel, kind, begins=begins)

    def close(self) -> None:
        """Close the socket."""
        try:
            self._bus.shutdown()
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot be closed: {error}", code="bus/io-failed"
            ) from error

    def _set_filters(self) -> None:
        """Let the kernel drop all messages that this end does not need."""
        filters = [(0, 0)]  # (id, mask): every frame with an 11-bit id
        if self._received_opcodes is not None:
            opcode_mask = LAST_STANDARD_ID & ~NODE_MASK
            filters = [(opcode << NODE_BITS, opcode_mask) for opcode in self._received_opcodes]
        data = b"".join(
            struct.pack("=II", identifier, mask | EXTENDED | REMOTE) for identifier, mask in filters
        )
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, data)

    def _record_error_frame(self, identifier: int, data: bytes) -> None:
        self._errors.extend(decode_error_frame(identifier, data, self.channel))

    def _record_os_error(self, error: OSError) -> None:
        """Report a full queue or an interface that went down. Raises BackendError for any other error."""
        match error.errno:
            case (
                errno.ENOBUFS | errno.EAGAIN
            ):  # the interface's queue, or this socket's share of it
                self._errors.append(
                    BusError("queue_full", self.channel, "the transmit queue is full")
                )
            case errno.ENETDOWN:
                self._record_interface_down()
            case errno.ENODEV | errno.ENXIO:
                self._is_unplugged = True
                self._record_interface_down()
            case _:
                raise BackendError(
                    f"{self.channel}: {error.strerror}", code="bus/io-failed"
                ) from error

    def _record_interface_down(self) -> None:
        if not self._is_down:
            state = "gone" if self._is_unplugged else "down"
            self._errors.append(
                BusError("interface_down", self.channel, f"the interface is {state}")
            )
        self._is_down = True

    def _record_interface_up(self) -> None:
        # An adapter that was plugged in again is another interface of the same name.
        if self._is_unplugged:
            try:
                self._socket.bind((self.channel,))
                self._set_filters()  # the kernel dropped them with the interface
            except OSError:
                return
        self._is_down = False
        self._is_unplugged = False
        self._errors.append(BusError("interface_up", self.channel, "the interface is up again"))

    def _read_drop_count(self) -> int:
        """Return how many received frames the kernel has dropped since the socket was opened; 0 if it is unknown."""
        try:
            raw = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO_FORMAT.size)
        except OSError:
            return 0
        if len(raw) != MEMINFO_FORMAT.size:
            return 0
        return MEMINFO_FORMAT.unpack(raw)[MEMINFO_DROPS]


def to_python_can(frame: CanFrame, *, fd: bool = False) -> can.Message:
    """Return a frame as a message of python-can. An id that does not fit 11 bits has 29."""
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=frame.id > LAST_STANDARD_ID,
        is_fd=fd,
        bitrate_switch=fd,
    )


class VirtualPeer(Protocol):
    """The other end of a virtual bus, in the same process."""

    def __call__(self) -> float | None:
        """Run briefly.

        Returns:
            Seconds until the next run is due; None if none is due before this end receives something.
        """
        ...

    def inject(self, injection: FaultInjection, *, begins: bool) -> None:
        """Start or end a fault of a module there."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


def make_virtual_channel() -> str:
    """Return a name that no other virtual bus has.

    It ends in a number, because tools that read log files take the last digits for the channel, as in can0.
    """
    return f"virtual-{uuid.uuid4().hex[:8]}-0"


class VirtualWire(FaultableWire):
    """One end of python-can's virtual bus."""

    def __init__(self, channel: str, peer: VirtualPeer | None = None, *, fd: bool = False) -> None:
        """Open one end.

        Args:
            channel: Name of the bus; both ends open the same one.
            peer: Other end of the bus, which is run whenever this end is idle; None if it runs by itself.
            fd: Whether the bus is CAN FD.
        """
        super().__init__(channel)
        self.peer = peer
        self._uses_fd = fd
        protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._bus = VirtualBus(channel=channel, protocol=protocol)

    def _send_frame(self, frame: CanFrame) -> bool:
        try:
            self._bus.send(to_python_can(frame, fd=self._uses_fd))
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot send: {error}", code="bus/io-failed"
            ) from error
        return True

    def _receive_frames(self) -> list[CanFrame]:
        frames: list[CanFrame] = []
        try:
            while (message := self._bus.recv(0)) is not None:
                frames.append(CanFrame(message.arbitration_id, bytes(message.data)))
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot receive: {error}", code="bus/io-failed"
            ) from error
        return frames

    def fileno(self) -> int | None:
        """Return None, because there is no file descriptor to wait on."""
        return None

    def idle(self) -> float | None:
        """Let the other end run, and return when it must run again."""
        idle_duration_s = math.inf if self.peer is None else self.peer()
        return idle_duration_s if self._bus.queue.empty() else 0.0

    def close(self) -> None:
        """Close this end, and the other one if it is run by this one."""
        if self.peer is not None:
            self.peer.close()
        try:
            self._bus.shutdown()
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot be closed: {error}", code="bus/io-failed"
            ) from error


def drain_socket(
    source: socket.socket,
    buffer: bytearray,
    frames: list[CanFrame],
    on_error: Callable[[int, bytes], None],
) -> None:
    """Read frames from a non-blocking raw CAN socket until it is empty, at most MAX_AT_ONCE.

    Args:
        source: Socket to read from.
        buffer: Memory for one frame of the kernel, which is overwritten.
        frames: List to which the data frames are appended.
        on_error: Function that is called with id and data of each error frame of the kernel.
    """
    # This loop runs for every frame, so it uses local names. `tuple.__new__` makes a CanFrame, which is a named tuple,
    # without the argument handling of its constructor.
    receive_into = source.recv_into
    unpack = RAW_FRAME_FORMAT.unpack
    append = frames.append
    new_tuple = tuple.__new__
    with contextlib.suppress(BlockingIOError):  # raised by `recv_into` when the socket is empty
        for _ in range(MAX_AT_ONCE):
            receive_into(buffer)
            identifier, length, data = unpack(buffer)
            if identifier & ERROR:
                on_error(identifier, data)
            else:
                append(new_tuple(CanFrame, (identifier, data[:length])))


def wait(wires: Sequence[Wire], timeout_s: float) -> bool:
    """Run the emulators in this process, then wait until a frame may have arrived on any bus, or until a timeout.

    Args:
        wires: This end of each bus.
        timeout_s: Maximum duration to wait.

    Returns:
        False if it did not wait, because nothing can arrive before this end sends something; otherwise True.

    Raises:
        BackendError: The file descriptor of a bus cannot be waited for.
    """
    idle_durations_s: list[float] = []
    for wire in wires:
        idle_duration_s = wire.idle()
        if idle_duration_s is not None:
            idle_durations_s.append(idle_duration_s)
    if not idle_durations_s:
        return False
    wait_s = max(min([timeout_s, *idle_durations_s]), 0.0)
    file_descriptors = [number for wire in wires if (number := wire.fileno()) is not None]
    if file_descriptors:
        try:
            select.select(file_descriptors, [], [], wait_s)
        except IO_ERRORS as error:
            channels = ", ".join(wire.channel for wire in wires)
            raise BackendError(
                f"{channels}: cannot be waited for: {error}", code="bus/io-failed"
            ) from error
    elif wait_s > 0:
        time.sleep(wait_s)
    return True


def receive_frames(
    wires: Sequence[Wire], timeout_s: float = MAX_WAIT_S
) -> Iterator[tuple[Wire, CanFrame]]:
    """Wait for at most MAX_WAIT_S and yield what has arrived. For the time before control cycles begin."""
    if not wait(wires, min(timeout_s, MAX_WAIT_S)):
        time.sleep(PAUSE_S)
    for wire in wires:
        for frame in wire.receive():
            yield wire, frame


def inject_into(wires: Sequence[Wire], injection: FaultInjection, *, begins: bool) -> bool:
    """Start or end an injected fault if its target is a bus.

    Returns:
        True if the target is a bus; False, without any effect, for a fault of something else.

    Raises:
        ConfigError: There is no such bus, or the fault cannot be injected there.
    """
    if injection.target_type != "bus":
        return False
    if injection.target_index >= len(wires):
        raise ConfigError(
            f"there is no {injection.target}; this robot has bus_1 to bus_{len(wires)}",
            code="injection/unknown-target",
        )
    wires[injection.target_index].inject(injection.kind, begins=begins)
    return True


def validate_interface(channel: str) -> None:
    """Check that a SocketCAN interface exists and is up.

    Raises:
        ConfigError: The kernel has no CAN, or the interface does not exist or is down. For the last two, the message
            contains the command that brings it up.
    """
    does_python_support_can = hasattr(socket, "AF_CAN")
    if not does_python_support_can or not _kernel_has_can():
        raise ConfigError(
            f"channel {channel!r}: this kernel has no CAN. Leave `backends.can.channels` empty for a virtual bus, or "
            f"run in a VM that has CAN: see docs/hardware/joint-modules.md",
            code="bus/not-available",
        )
    bring_up = "deploy/can/up.sh"
    if not Path("/sys/class/net", channel).exists():
        raise ConfigError(
            f"channel {channel!r}: there is no such interface; `{bring_up} {channel}` creates it",
            code="bus/not-available",
        )
    if not is_up(channel):
        raise ConfigError(
            f"channel {channel!r}: the interface is down; `{bring_up} {channel}` brings it up",
            code="bus/not-available",
        )


def is_up(channel: str) -> bool:
    """Return whether an interface exists and is administratively up."""
    try:
        flags = int(Path("/sys/class/net", channel, "flags").read_text(encoding="ascii"), 16)
    except (
        OSError,
        ValueError,
    ):  # the latter: the file of an interface that is going away is empty
        return False
    return bool(flags & INTERFACE_UP)


def _kernel_has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True
