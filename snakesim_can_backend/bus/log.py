"""A log of all frames on the wires, in candump's format: `(1700000000.000000) can0 105#00112233 R`.

R was received, T transmitted; of CAN FD `can0 00008001##1...`. Frames that were read together have one time.
"""

import contextlib
import logging
import time
from pathlib import Path
from typing import TextIO

from snakesim_can_backend.bus.bus import LAST_STANDARD_ID, Wire
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.base.errors import ConfigError

FLUSH_BYTES = 1 << 16
FD_MARK = "##1"  # a second bit rate

_log = logging.getLogger("snakesim.can")


def open_log(path: Path, backend: str = "can") -> TextIO:
    """Begin a log. backend: whose setting it is. Raises ConfigError."""
    try:
        return path.open("w", encoding="utf-8", errors="backslashreplace", buffering=FLUSH_BYTES)
    except OSError as error:
        raise ConfigError(f"`backends.{backend}.log` = {str(path)!r}: {error.strerror}; choose another file") from error


class LoggedWire:
    """A wire that keeps a log. Several may share one file."""

    def __init__(self, wire: Wire, log: TextIO, *, fd: bool = False) -> None:
        self._wire, self._log, self._mark = wire, log, FD_MARK if fd else "#"
        self.channel = wire.channel
        # As the wire does. Injected faults: frames that do not reach it are not logged.
        self.errors, self.fileno, self.idle, self.inject = wire.errors, wire.fileno, wire.idle, wire.inject
        self._full = False

    def send(self, frame: Frame) -> bool:
        """Send, and log accepted frames."""
        taken = self._wire.send(frame)
        if taken:
            self._write([frame], "T")
        return taken

    def receive(self) -> list[Frame]:
        """Receive, and log all frames."""
        frames = self._wire.receive()
        if frames:
            self._write(frames, "R")
        return frames

    def close(self) -> None:
        """Close the wire; the log is complete."""
        with contextlib.suppress(OSError):
            self._log.flush()
        self._wire.close()

    def _write(self, frames: list[Frame], direction: str) -> None:
        if self._full:
            return
        place = f"({time.time():.6f}) {self.channel}"
        try:
            for frame in frames:
                name = f"{frame.id:03X}" if frame.id <= LAST_STANDARD_ID else f"{frame.id:08X}"
                self._log.write(f"{place} {name}{self._mark}{frame.data.hex().upper()} {direction}\n")
        except OSError as error:  # a full disk ends the log, and nothing else
            self._full = True
            _log.warning("the bus log ends here: %s", error.strerror)
