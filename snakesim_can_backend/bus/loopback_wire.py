"""A CAN bus between the processes of one computer, without a kernel module: `loopback:FOLDER`.

Every end has a UDP socket on 127.0.0.1, and a file in the folder of the bus that is named after its process and port.
A frame that one end sends arrives at all others. There are no bit rate and no arbitration. It is for emulated drives:
never for real ones, because every local process can send to these sockets.
"""

import contextlib
import math
import os
import socket
import struct
import time
from collections.abc import Iterable
from pathlib import Path

from snakesim_can_backend.bus.faultable_wire import FaultableWire
from snakesim_can_backend.protocol.definitions import NODE_BITS, CanFrame, Opcode
from snakesim_hal.base.errors import BackendError

INTERFACE = "loopback"
LOCALHOST = "127.0.0.1"
RECEIVE_BUFFER_BYTES = 1 << 20  # frames of a process that does not run for some time
MAX_DATAGRAM_BYTES = 128  # an id and at most 64 bytes of CAN FD
MAX_AT_ONCE = 4096  # frames
LIST_PERIOD_S = 0.05  # after which the other ends of the bus are looked up again
_ID = struct.Struct("<I")


class LoopbackWire(FaultableWire):
    """One end of a bus between processes of this computer."""

    def __init__(self, channel: str, folder: str, only: Iterable[Opcode] | None = None) -> None:
        """Open an end, and make the bus if this is the first one.

        Args:
            channel: Name of the channel, for messages.
            folder: Folder of the bus.
            only: Opcodes of the messages to receive; None for all messages.

        Raises:
            BackendError: The folder cannot be used.
        """
        super().__init__(channel)
        self._folder = Path(folder)
        self._received_opcodes = None if only is None else frozenset(int(opcode) for opcode in only)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        try:
            self._socket.bind((LOCALHOST, 0))
            self._port: int = self._socket.getsockname()[1]
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._marker = self._folder / f"{os.getpid()}-{self._port}"
            self._marker.touch()
        except OSError as error:
            self._socket.close()
            raise BackendError(
                f"{channel}: cannot be opened: {error}", code="bus/cannot-open"
            ) from error
        self._other_ports: list[int] = []
        self._next_list_s = 0.0

    def _send_frame(self, frame: CanFrame) -> bool:
        """Send a frame to all other ends. Each accepts it, or loses it if its buffer is full."""
        datagram = _ID.pack(frame.id) + frame.data
        for port in self._list_other_ports():
            with contextlib.suppress(
                OSError
            ):  # a full buffer loses the frame, as that of a kernel interface does
                self._socket.sendto(datagram, (LOCALHOST, port))
        return True

    def _receive_frames(self) -> list[CanFrame]:
        frames: list[CanFrame] = []
        with contextlib.suppress(OSError):
            for _ in range(MAX_AT_ONCE):
                datagram = self._socket.recv(MAX_DATAGRAM_BYTES)
                if len(datagram) < _ID.size:
                    continue
                (identifier,) = _ID.unpack_from(datagram)
                if (
                    self._received_opcodes is None
                    or identifier >> NODE_BITS in self._received_opcodes
                ):
                    frames.append(CanFrame(identifier, datagram[_ID.size :]))
        return frames

    def fileno(self) -> int | None:
        """Return the socket's file descriptor."""
        return self._socket.fileno()

    def idle(self) -> float | None:
        """Return that a frame may arrive at any time."""
        return math.inf

    def close(self) -> None:
        """Leave the bus."""
        self._marker.unlink(missing_ok=True)
        self._socket.close()

    def _list_other_ports(self) -> list[int]:
        """Return the ports of the other ends. Files of processes that were killed are removed."""
        now_s = time.monotonic()
        if now_s < self._next_list_s:
            return self._other_ports
        self._next_list_s = now_s + LIST_PERIOD_S
        ports: list[int] = []
        with contextlib.suppress(OSError):  # the folder is gone
            for name in os.listdir(self._folder):  # noqa: PTH208 - names alone, several times a second
                process_text, _, port_text = name.partition("-")
                if (
                    not (process_text.isdecimal() and port_text.isdecimal())
                    or int(port_text) == self._port
                ):
                    continue
                if Path("/proc", process_text).exists():
                    ports.append(int(port_text))
                else:
                    (self._folder / name).unlink(missing_ok=True)
        self._other_ports = ports
        return ports
