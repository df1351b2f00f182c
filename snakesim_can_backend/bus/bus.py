"""One end of a CAN bus: frames in, frames out, and bus errors.

`SocketCanWire` is a kernel interface (can0, vcan0). python-can opens and filters it; frames go through its socket
directly, which costs a third of a `can.Message` each. `VirtualWire` is python-can's virtual bus between two ends in one
process, for machines whose kernel has no CAN. It does *not* simulate arbitration and bit rate; errors, a full queue and
an interface that goes down only as injected faults: see `bus_faults`.
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
from snakesim_can_backend.bus.bus_faults import VirtualFaults, inject_into_interface
from snakesim_can_backend.protocol.definitions import NODE_BITS, Frame, Opcode
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.fault_kinds import Injection

EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
RECEIVE_BUFFER_BYTES = 1 << 20
LAST_STANDARD_ID = 0x7FF
MAX_AT_ONCE = 4096  # a babbling bus must not block its reader for ever
MOMENT_S, PAUSE_S = 0.01, 0.001
SO_MEMINFO, MEMINFO_DROPS, MEMINFO_BYTES = 55, 8, 36  # linux/sock_diag.h
IO_ERRORS = (OSError, ValueError, can.CanError)  # of sockets, of `select` and of python-can
_wire_format = struct.Struct("<IB3x8s")


class Wire(Protocol):
    """One end of a bus. Errors are reported by `errors` or a BackendError, never another exception."""

    channel: str

    def send(self, frame: Frame) -> bool:
        """Send a frame. False when it was not accepted; `errors` says why, and nothing is queued for later."""
        ...

    def receive(self) -> list[Frame]:
        """All received frames, in order; never waits."""
        ...

    def errors(self) -> list[BusError]:
        """Bus errors since the last call."""
        ...

    def fileno(self) -> int | None:
        """File descriptor to wait on; None for a bus inside this process."""
        ...

    def idle(self) -> float | None:
        """Let the other end run, if it is in this process.

        Seconds until a frame may arrive, 0 if there is one; None: not before this end sends something.
        """
        ...

    def inject(self, kind: str, *, begins: bool) -> None:
        """Begin or end an injected bus fault: see `snakesim_hal.model.fault_kinds`. Raises ConfigError."""
        ...

    def close(self) -> None:
        """Close the bus."""
        ...


class SocketCanWire:
    """A SocketCAN interface."""

    def __init__(self, channel: str, only: Iterable[Opcode] | None = None) -> None:
        """only: messages to receive, filtered in the kernel; None: all with 11-bit ids.

        Raises ConfigError for a missing interface, BackendError for one that cannot be opened.
        """
        check_interface(channel)
        self.channel = channel
        self._only = None if only is None else list(only)
        try:
            self._bus = SocketcanBus(channel=channel, ignore_rx_error_frames=False)
            self._socket = self._bus.socket
            self._set_filters()
            self._socket.setblocking(False)
        except IO_ERRORS as error:
            raise BackendError(f"{channel}: cannot be opened: {error}") from error
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self._buffer = bytearray(_wire_format.size)
        self._found: list[BusError] = []
        self._down = self._gone = False
        self._dropped = 0

    def send(self, frame: Frame) -> bool:
        """Send a frame; False when the queue is full or the interface is down."""
        try:
            self._socket.send(_wire_format.pack(frame.id, len(frame.data), frame.data))
        except OSError as error:
            self._note_failure(error)
            return False
        if self._down:
            self._note_up()
        return True

    def receive(self) -> list[Frame]:
        """All received frames."""
        frames: list[Frame] = []
        try:
            drain_socket(self._socket, self._buffer, frames, self._note_error)
        except OSError as error:
            self._note_failure(error)
        return frames

    def errors(self) -> list[BusError]:
        """Bus errors since the last call."""
        dropped = self._count_drops()
        if dropped > self._dropped:
            detail = f"the kernel dropped {dropped - self._dropped} frames: this process reads too slowly"
            self._found.append(BusError("receive_overflow", self.channel, detail))
            self._dropped = dropped
        if self._down and is_up(self.channel):
            self._note_up()
        found, self._found = self._found, []
        return found

    def fileno(self) -> int | None:
        """The socket."""
        return self._socket.fileno()

    def idle(self) -> float | None:
        """The other end runs by itself."""
        return math.inf

    def inject(self, kind: str, *, begins: bool) -> None:
        """Begin or end a fault: the interface goes down, or an error frame reports an error."""
        inject_into_interface(self.channel, kind, begins=begins)

    def close(self) -> None:
        """Close the socket."""
        try:
            self._bus.shutdown()
        except IO_ERRORS as error:
            raise BackendError(f"{self.channel}: cannot be closed: {error}") from error

    def _set_filters(self) -> None:
        all_nodes = 0x7FF & ~((1 << NODE_BITS) - 1)
        wanted = [(0, 0)] if self._only is None else [(opcode << NODE_BITS, all_nodes) for opcode in self._only]
        data = b"".join(struct.pack("=II", id_, mask | EXTENDED | REMOTE) for id_, mask in wanted)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, data)

    def _note_error(self, identifier: int, data: bytes) -> None:
        self._found.extend(decode_error_frame(identifier, data, self.channel))

    def _note_failure(self, error: OSError) -> None:
        if error.errno in (errno.ENOBUFS, errno.EAGAIN):  # the interface's queue, or this socket's share of it
            self._found.append(BusError("queue_full", self.channel, "the transmit queue is full"))
        elif error.errno in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
            self._gone |= error.errno != errno.ENETDOWN
            if not self._down:
                what = "gone" if self._gone else "down"
                self._found.append(BusError("interface_down", self.channel, f"the interface is {what}"))
            self._down = True
        else:
            raise BackendError(f"{self.channel}: {error.strerror}") from error

    def _note_up(self) -> None:
        if self._gone:  # an adapter that was plugged in again is another interface of the same name
            try:
                self._socket.bind((self.channel,))
                self._set_filters()  # the kernel dropped them with the interface
            except OSError:
                return
        self._down = self._gone = False
        self._found.append(BusError("interface_up", self.channel, "the interface is up again"))

    def _count_drops(self) -> int:
        try:
            raw = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO_BYTES)
        except OSError:
            return 0
        return struct.unpack("=9I", raw)[MEMINFO_DROPS] if len(raw) == MEMINFO_BYTES else 0


def to_python_can(frame: Frame, *, fd: bool = False) -> can.Message:
    """As python-can has it. An id that does not fit 11 bits has 29."""
    extended = frame.id > LAST_STANDARD_ID
    return can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=extended, is_fd=fd, bitrate_switch=fd)


class VirtualPeer(Protocol):
    """The other end of a virtual bus, in the same process."""

    def __call__(self) -> float | None:
        """Run briefly; seconds until the next run is due, None: not before it receives something."""
        ...

    def inject(self, injection: Injection, *, begins: bool) -> None:
        """Begin or end a fault of a module there."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


def make_virtual_channel() -> str:
    """A name that no other virtual bus has. Its last digits are a channel: log files take them for one, as of can0."""
    return f"virtual-{uuid.uuid4().hex[:8]}-0"


class VirtualWire:
    """One end of python-can's virtual bus."""

    def __init__(self, channel: str, peer: VirtualPeer | None = None, *, fd: bool = False) -> None:
        """peer: runs the other end whenever this one is idle; returns when its next run is due."""
        self.channel = channel
        self.peer = peer
        self._fd = fd
        self._bus = VirtualBus(channel=channel, protocol=can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20)
        self._faults = VirtualFaults(channel)

    def send(self, frame: Frame) -> bool:
        """Send a frame; a virtual bus accepts everything, unless a fault is active."""
        if self._faults.on and (taken := self._faults.stops_sending()) is not None:
            return taken
        try:
            self._bus.send(to_python_can(frame, fd=self._fd))
        except IO_ERRORS as error:
            raise BackendError(f"{self.channel}: cannot send: {error}") from error
        return True

    def receive(self) -> list[Frame]:
        """All received frames."""
        frames: list[Frame] = []
        try:
            while (message := self._bus.recv(0)) is not None:
                frames.append(Frame(message.arbitration_id, bytes(message.data)))
        except IO_ERRORS as error:
            raise BackendError(f"{self.channel}: cannot receive: {error}") from error
        return self._faults.leaves(frames) if self._faults.on else frames

    def errors(self) -> list[BusError]:
        """A virtual bus has only injected errors."""
        return self._faults.take_errors()

    def fileno(self) -> int | None:
        """None: there is nothing to wait on."""
        return None

    def idle(self) -> float | None:
        """Let the other end run."""
        pause_s = math.inf if self.peer is None else self.peer()
        return pause_s if self._bus.queue.empty() else 0.0

    def inject(self, kind: str, *, begins: bool) -> None:
        """Begin or end a fault, as this end would see it on a kernel interface; the other end is not affected."""
        self._faults.inject(kind, begins=begins)

    def close(self) -> None:
        """Close this end, and the other one if it is run by this one."""
        if self.peer is not None:
            self.peer.close()
        try:
            self._bus.shutdown()
        except IO_ERRORS as error:
            raise BackendError(f"{self.channel}: cannot be closed: {error}") from error


def drain_socket(
    source: socket.socket, buffer: bytearray, frames: list[Frame], on_error: Callable[[int, bytes], None]
) -> None:
    """Append all frames of a non-blocking raw CAN socket; error frames of the kernel go to `on_error`."""
    receive_into, unpack, append = source.recv_into, _wire_format.unpack, frames.append
    new = tuple.__new__  # as Frame(...), without its argument handling
    with contextlib.suppress(BlockingIOError):
        for _ in range(MAX_AT_ONCE):
            receive_into(buffer)
            identifier, length, data = unpack(buffer)
            if identifier & ERROR:
                on_error(identifier, data)
            else:
                append(new(Frame, (identifier, data[:length])))


def wait(wires: Sequence[Wire], timeout_s: float) -> bool:
    """Wait until a frame may have arrived on any of them, or the timeout. Other ends in this process run meanwhile.

    False when nothing can arrive before this end sends something. Raises BackendError.
    """
    pauses = [pause for wire in wires if (pause := wire.idle()) is not None]
    if not pauses:
        return False
    files = [number for wire in wires if (number := wire.fileno()) is not None]
    timeout_s = max(min([timeout_s, *pauses]), 0.0)
    if files:
        try:
            select.select(files, [], [], timeout_s)
        except IO_ERRORS as error:
            channels = ", ".join(wire.channel for wire in wires)
            raise BackendError(f"{channels}: cannot be waited for: {error}") from error
    elif timeout_s > 0:
        time.sleep(timeout_s)
    return True


def receive_frames(wires: Sequence[Wire], limit_s: float = MOMENT_S) -> Iterator[tuple[Wire, Frame]]:
    """What has come after a moment at most; for the time before ticks begin."""
    if not wait(wires, min(limit_s, MOMENT_S)):
        time.sleep(PAUSE_S)
    for wire in wires:
        for frame in wire.receive():
            yield wire, frame


def inject_into(wires: Sequence[Wire], injection: Injection, *, begins: bool) -> bool:
    """Begin or end a fault of a bus; False for a fault of something else. Raises ConfigError."""
    if injection.target_type != "bus":
        return False
    if injection.number >= len(wires):
        raise ConfigError(f"there is no {injection.target}; this robot has bus_1 to bus_{len(wires)}")
    wires[injection.number].inject(injection.kind, begins=begins)
    return True


def check_interface(channel: str) -> None:
    """Raise ConfigError unless a SocketCAN interface exists and is up; the message says how to bring it up."""
    if not hasattr(socket, "AF_CAN") or not _kernel_has_can():
        raise ConfigError(
            f"channel {channel!r}: this kernel has no CAN. Leave `backends.can.channels` empty for a virtual bus, or "
            f"run in a VM that has CAN: see docs/hil.md"
        )
    bring_up = "deploy/can/up.sh"
    if not Path("/sys/class/net", channel).exists():
        raise ConfigError(f"channel {channel!r}: there is no such interface; `{bring_up} {channel}` creates it")
    if not is_up(channel):
        raise ConfigError(f"channel {channel!r}: the interface is down; `{bring_up} {channel}` brings it up")


def is_up(channel: str) -> bool:
    """Whether an interface exists and is administratively up."""
    try:
        return bool(int(Path("/sys/class/net", channel, "flags").read_text(encoding="ascii"), 16) & 1)
    except (OSError, ValueError):  # the latter: the file of an interface that is going away is empty
        return False


def _kernel_has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True
