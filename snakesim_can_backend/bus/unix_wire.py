"""One end of a bus on a Unix socket: for emulated modules in another process, on kernels without CAN.

The modules' process listens at a path, and the driver connects. The stream carries, for each frame, the 16 bytes of the
kernel's `struct can_frame`. Like a virtual bus it has no bit rate and no arbitration, and its faults are injected ones.
"""

import math
import socket
from pathlib import Path

from snakesim_can_backend.bus.bus import IO_ERRORS, LAST_STANDARD_ID, RAW_FRAME_FORMAT
from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.bus.faultable_wire import FaultableWire
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import BackendError, ConfigError

UNIX = "unix"  # a channel is `unix:PATH`
MAX_PATH_BYTES = 107  # of `sun_path`, with its end: linux/un.h
RECEIVE_BYTES = 1 << 16


def validate_socket(path: str) -> None:
    """Check that emulated modules listen at a path. Raises ConfigError."""
    if len(path.encode()) > MAX_PATH_BYTES:
        raise ConfigError(
            f"channel 'unix:{path}': the path has {len(path.encode())} bytes, at most {MAX_PATH_BYTES}",
            code="bus/invalid-channel",
        )
    if not Path(path).is_socket():
        raise ConfigError(
            f"channel 'unix:{path}': there is no such socket; `snakesim drive emulate can SCENARIO --firmware "
            f"--channel unix:{path}` creates it",
            code="bus/not-available",
        )


class UnixWire(FaultableWire):
    """The driver's end of a bus on a Unix socket."""

    def __init__(self, path: str) -> None:
        """Connect to the emulated modules.

        Args:
            path: Path of the socket.

        Raises:
            ConfigError: There is no such socket.
            BackendError: No process listens there.
        """
        validate_socket(path)
        super().__init__(f"{UNIX}:{path}")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(path)
            self._socket.setblocking(False)
        except OSError as error:
            self._socket.close()
            raise BackendError(
                f"{self.channel}: cannot be opened: {error}", code="bus/cannot-open"
            ) from error
        self._received = b""  # the beginning of a frame that has not arrived completely
        self._errors: list[BusError] = []
        self._is_down = False  # whether the modules' process has ended

    def _send_frame(self, frame: CanFrame) -> bool:
        """Send a frame; return False if the modules' process does not read, or has ended."""
        record = RAW_FRAME_FORMAT.pack(frame.id, len(frame.data), frame.data)
        try:
            sent_bytes = self._socket.send(record)
            while sent_bytes < len(
                record
            ):  # the rest of a frame must follow, or all later ones are shifted
                self._socket.setblocking(True)
                sent_bytes += self._socket.send(record[sent_bytes:])
                self._socket.setblocking(False)
        except BlockingIOError:
            self._errors.append(BusError("queue_full", self.channel, "the transmit queue is full"))
            return False
        except OSError:
            self._record_end()
            return False
        return True

    def _receive_frames(self) -> list[CanFrame]:
        data = self._received + self._read_all()
        complete_bytes = len(data) - len(data) % RAW_FRAME_FORMAT.size
        self._received = data[complete_bytes:]
        return [
            CanFrame(identifier, payload[:length])
            for identifier, length, payload in RAW_FRAME_FORMAT.iter_unpack(data[:complete_bytes])
            if identifier <= LAST_STANDARD_ID
        ]

    def errors(self) -> list[BusError]:
        """Return the errors since the last call, with injected ones."""
        errors = self._errors + super().errors()
        self._errors = []
        return errors

    def fileno(self) -> int | None:
        """Return the socket's file descriptor; None if nothing can arrive any more."""
        return None if self._is_down else self._socket.fileno()

    def idle(self) -> float | None:
        """Return infinity, because a frame may arrive at any time; None if nothing can arrive any more."""
        return None if self._is_down else math.inf

    def close(self) -> None:
        """Close the socket."""
        try:
            self._socket.close()
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot be closed: {error}", code="bus/io-failed"
            ) from error

    def _read_all(self) -> bytes:
        chunks: list[bytes] = []
        while not self._is_down:
            try:
                chunk = self._socket.recv(RECEIVE_BYTES)
            except BlockingIOError:
                break
            except OSError:
                chunk = b""
            if not chunk:
                self._record_end()
            chunks.append(chunk)
        return b"".join(chunks)

    def _record_end(self) -> None:
        if not self._is_down:
            self._errors.append(
                BusError("interface_down", self.channel, "the process with the modules has ended")
            )
        self._is_down = True
