"""A half-duplex serial bus: a port behind a USB adapter, or a pseudo terminal with emulated drives at its other end.

Who asks waits for the answer before anybody is asked again. An FTDI adapter holds back what it received for its latency
timer, 16 ms at first: opening a port asks its driver for 1 ms.
"""

import contextlib
import os
import select
import termios
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import serial

from snakesim_hal.base.errors import BackendError, ConfigError

BITS_A_BYTE = 10  # with start and stop
USB_LATENCY_S = 0.001  # of an adapter whose driver does not say it: a frame of USB
PEER_LIMIT_S = 5.0  # in which a pseudo terminal hands on what was written
REOPEN_EVERY_S = 0.5
READ_BYTES = 4096
WRITE_LIMIT_S = 1.0
GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL
IO_ERRORS = (OSError, termios.error, ValueError)  # of pyserial and of `select`, on a port that has gone


# Drives that are emulated in this process: they handle what was sent to them, answer, and let time pass up to now.
Peer = Callable[[], None]


class Pty:
    """A pseudo terminal. Emulated drives are at its one end; at the other is whoever opens `path`.

    due: bytes that were written to it and must arrive; None: nobody in this process knows.
    """

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        self._ends: tuple[int, ...] = (self._master, self._slave)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.due: int | None = None
        self._taken = 0
        self.given = 0

    def take(self) -> bytes:
        """What has arrived; all that is due, which the kernel may hand on late."""
        taken = self._read()
        while self.due is not None and self._taken < self.due:
            if not select.select([self._master], [], [], PEER_LIMIT_S)[0]:
                raise BackendError(f"{self.path}: the kernel has not handed on what was written to it")
            taken += self._read()
        return taken

    def give(self, data: bytes) -> None:
        """Answer; what nobody reads is lost once the kernel's buffer is full."""
        with contextlib.suppress(BlockingIOError):
            self.given += os.write(self._master, data)

    def fileno(self) -> int:
        """To wait on."""
        return self._master

    def close(self) -> None:
        """Both ends, once: their numbers may be another file's afterwards."""
        ends, self._ends = self._ends, ()
        for end in ends:
            os.close(end)

    def _read(self) -> bytes:
        try:
            data = os.read(self._master, READ_BYTES)
        except (BlockingIOError, OSError):
            return b""
        self._taken += len(data)
        return data


class SerialWire:
    """One port, opened for this process alone."""

    def __init__(
        self, port: str, baud: int, log: TextIO | None = None, pty: Pty | None = None, peer: Peer | None = None
    ) -> None:
        """pty, peer: drives that are emulated in this process. Raises ConfigError and BackendError."""
        self.port, self.baud = port, baud
        self._log, self._pty, self._peer = log, pty, peer
        self._received, self._sent = 0, 0
        self._lost_s: float | None = None  # since when the port is gone
        self._cut = False
        if not Path(port).exists():
            raise ConfigError(f"port {port!r}: there is none; plug the adapter in, and see `snakesim doctor`")
        try:
            self._serial = self._open()
        except IO_ERRORS as error:
            raise BackendError(f"{port}: cannot be opened: {error}. Is another program using it?") from error
        self.latency_s = latency_s(port)

    def send(self, data: bytes) -> None:
        """Send, after throwing away whatever came too late."""
        if self._cut or (self._lost_s is not None and not self._reopened()):
            return
        self._throw_away()
        self._note("out", data)
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:  # pyserial says it also of what it has written, after a long pause
            if self._pty is None:
                return
        except IO_ERRORS:
            self._lose()
            return
        self._sent += len(data)
        if self._pty is not None:
            self._pty.due = self._sent

    def receive(self, timeout_s: float) -> bytes:
        """What has come; waits for the first of it. Nothing: the time is over, or no emulated drive has answered."""
        if self._cut or self._lost_s is not None:
            return b""
        if self._peer is not None and self._pty is not None:
            self._peer()
            if self._received == self._pty.given:
                return b""
            timeout_s = PEER_LIMIT_S
        try:
            data = self._read(timeout_s)
        except IO_ERRORS:
            self._lose()
            return b""
        if data:
            self._received += len(data)
            self._note("in", data)
        return data

    def time_s(self, size: int) -> float:
        """That so many bytes take."""
        return size * BITS_A_BYTE / self.baud

    def let_run(self) -> None:
        """Emulated drives in this process."""
        if self._peer is not None:
            self._peer()

    def error(self) -> str:
        """Why nothing can be sent now; empty if it can."""
        if self._cut:
            return "it is cut"
        return "" if self._lost_s is None else "it is gone: the adapter was unplugged, or its driver has failed"

    def cut(self, *, begins: bool) -> None:
        """An injected fault: nothing gets through until it ends."""
        self._cut = begins

    def close(self) -> None:
        """Close the port, and the pseudo terminal that is this one's other end."""
        with contextlib.suppress(OSError):
            self._serial.close()
        if self._pty is not None:
            self._pty.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _open(self) -> serial.Serial:
        opened = serial.Serial(self.port, self.baud, timeout=0, write_timeout=WRITE_LIMIT_S, exclusive=True)
        with contextlib.suppress(*IO_ERRORS):  # pseudo terminals and some adapters have no such thing
            opened.set_low_latency_mode(True)
        return opened

    def _read(self, timeout_s: float) -> bytes:
        """What there is, or comes in time. The kernel now and then says too early that there is something."""
        number, end_s = self._serial.fileno(), time.monotonic() + timeout_s
        waiting = select.poll()
        waiting.register(number, select.POLLIN)
        while said := waiting.poll(max(end_s - time.monotonic(), 0.0) * 1000):
            if said[0][1] & GONE:
                raise OSError("suspended up")
            if data := os.read(number, READ_BYTES):
                return data
        return b""

    def _throw_away(self) -> None:
        if self._pty is not None:
            while self._received < self._pty.given and self.receive(PEER_LIMIT_S):
                pass
            return
        with contextlib.suppress(*IO_ERRORS):
            self._serial.reset_input_buffer()

    def _lose(self) -> None:
        self._lost_s = time.monotonic()
        with contextlib.suppress(OSError):
            self._serial.close()

    def _reopened(self) -> bool:
        now_s = time.monotonic()
        if self._lost_s is None or now_s - self._lost_s < REOPEN_EVERY_S:
            return self._lost_s is None
        self._lost_s = now_s
        try:
            self._serial = self._open()
        except IO_ERRORS:
            return False
        self._lost_s = None
        return True

    def _note(self, way: str, data: bytes) -> None:
        if self._log is not None:
            self._log.write(f"({time.monotonic():.6f}) {self.port} {way:<3} {data.hex(' ')}\n")


def is_emulated(port: str) -> bool:
    """Whether no real drive can be on a port: it is a pseudo terminal."""
    return Path(port).resolve().parts[:3] == ("/", "dev", "pts")


def latency_s(port: str, root: Path = Path("/")) -> float:
    """How long an adapter may hold back what it received."""
    try:
        name = Path(port).resolve().name
        return int((root / "sys/class/tty" / name / "device/latency_timer").read_text()) / 1000
    except (OSError, ValueError):
        return 0.0 if is_emulated(port) else USB_LATENCY_S
