"""Writes a log of all frames on the wires, in candump's format: `(1700000000.000000) can0 105#00112233 R`.

R marks received frames, T transmitted ones. CAN FD is written as `can0 00008001##1...`. Frames that were read together
have the same time.
"""

import contextlib
import logging
import time
from pathlib import Path
from typing import TextIO

from snakesim_can_backend.bus.bus import LAST_STANDARD_ID, Wire
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import ConfigError

FLUSH_BYTES = 1 << 16
CLASSIC_MARK = "#"
FD_MARK = "##1"  # the digit is the flags; 1: the data had a second bit rate

_log = logging.getLogger("snakesim.can")


def open_log(path: Path, backend: str = "can") -> TextIO:
    """Open a new log file.

    Args:
        path: Path of the file.
        backend: Name of the backend whose settings name the file, used in the error message.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        return path.open("w", encoding="utf-8", errors="backslashreplace", buffering=FLUSH_BYTES)
    except OSError as error:
        raise ConfigError(
            f"`backends.{backend}.log` = {str(path)!r}: {error.strerror}; choose another file",
            code="file/not-writable",
        ) from error


class LoggedWire:
    """A wire that logs its frames. Several may share one file."""

    def __init__(self, wire: Wire, log: TextIO, *, fd: bool = False) -> None:
        self._wire = wire
        self._log = log
        self._mark = FD_MARK if fd else CLASSIC_MARK
        self._is_full = False  # the disk
        self.channel = wire.channel
        # Everything else is done by the wire itself. Frames that an injected fault stops are not logged.
        self.errors = wire.errors
        self.fileno = wire.fileno
        self.idle = wire.idle
        self.inject = wire.inject

    def send(self, frame: CanFrame) -> bool:
        """Send a frame, log it if the bus accepted it, and return whether it did."""
        accepted = self._wire.send(frame)
        if accepted:
            self._write([frame], "T")
        return accepted

    def receive(self) -> list[CanFrame]:
        """Return all received frames, and log them."""
        frames = self._wire.receive()
        if frames:
            self._write(frames, "R")
        return frames

    def close(self) -> None:
        """Complete the log, and close the wire."""
        with contextlib.suppress(OSError):
            self._log.flush()
        self._wire.close()

    def _write(self, frames: list[CanFrame], direction: str) -> None:
        if self._is_full:
            return
        prefix = f"({time.time():.6f}) {self.channel}"
        try:
            for frame in frames:
                identifier = (
                    f"{frame.id:03X}" if frame.id <= LAST_STANDARD_ID else f"{frame.id:08X}"
                )
                self._log.write(
                    f"{prefix} {identifier}{self._mark}{frame.data.hex().upper()} {direction}\n"
                )
        except OSError as error:  # a full disk ends the log, and nothing else
            self._is_full = True
            _log.warning("the bus log ends here: %s", error.strerror)
