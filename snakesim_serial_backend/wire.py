"""A half-duplex serial bus: a port behind a USB adapter, or a pseudo terminal with emulated drives at its other end.

After a request the driver waits for the answer before it sends the next one. An FTDI adapter holds back received bytes
until its latency timer expires, 16 ms by default; opening a port sets it to 1 ms.
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

BITS_PER_BYTE = 10  # with start and stop bit
USB_LATENCY_S = 0.001  # of an adapter whose driver does not report it: one frame of USB
KERNEL_TIMEOUT_S = 5.0  # in which a pseudo terminal passes on what was written
REOPEN_PERIOD_S = 0.5  # between two attempts to open a port that is gone
READ_BYTES = 4096
WRITE_TIMEOUT_S = 1.0
DISCONNECTED_EVENTS = select.POLLHUP | select.POLLERR | select.POLLNVAL
# Of pyserial and of `select`, on a port that is gone.
IO_ERRORS = OSError, termios.error, ValueError

# Runs the drives that are emulated in this process: they handle what was sent to them, answer, and let time pass.
RunDrives = Callable[[], None]


class PseudoTerminal:
    """A pseudo terminal. Emulated drives are at its one end; at the other is the program that opens `path`.

    Attributes:
        path: Name of the end for the driver.
        expected_bytes: How many bytes were written to it so far and must arrive; None if this process does not know.
        sent_bytes: How many bytes the emulated drives have sent.
    """

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        self._open_ends: tuple[int, ...] = (self._master, self._slave)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.expected_bytes: int | None = None
        self.sent_bytes = 0
        self._received_bytes = 0
        self._is_cut = False  # by an injected fault

    def receive(self) -> bytes:
        """Return what has arrived. Waits for all expected bytes, which the kernel may pass on late."""
        data = self._read()
        while self.expected_bytes is not None and self._received_bytes < self.expected_bytes:
            readable, _, _ = select.select([self._master], [], [], KERNEL_TIMEOUT_S)
            if not readable:
                raise BackendError(
                    f"{self.path}: the kernel has not handed on what was written to it",
                    code="bus/io-failed",
                )
            data += self._read()
        return b"" if self._is_cut else data

    def inject(self, kind: str, *, begins: bool) -> None:
        """Start or end the fault "cut", in which nothing passes. Raises ConfigError for other kinds."""
        if kind != "cut":
            raise ConfigError(
                f"fault {kind}: a pseudo terminal knows only cut", code="injection/not-supported"
            )
        self._is_cut = begins

    def send(self, data: bytes) -> None:
        """Send an answer. If no program reads it, it is lost once the kernel's buffer is full."""
        if self._is_cut:
            return
        with contextlib.suppress(BlockingIOError):
            self.sent_bytes += os.write(self._master, data)

    def fileno(self) -> int:
        """Return the file descriptor to wait on."""
        return self._master

    def close(self) -> None:
        """Close both ends, once: their numbers may be another file's afterwards."""
        ends = self._open_ends
        self._open_ends = ()
        for end in ends:
            os.close(end)

    def _read(self) -> bytes:
        try:
            data = os.read(self._master, READ_BYTES)
        except (BlockingIOError, OSError):
            return b""
        self._received_bytes += len(data)
        return data


class SerialWire:
    """One port, opened for this process alone unless it only reads beside another one."""

    def __init__(
        self,
        port: str,
        baud: int,
        log: TextIO | None = None,
        pty: PseudoTerminal | None = None,
        run_drives: RunDrives | None = None,
        *,
        exclusive: bool = True,
    ) -> None:
        """Open a serial port.

        Args:
            port: Name of the serial port, or path of a pseudo terminal.
            baud: Baud rate in bit/s.
            log: Text file to which a line is written for everything that is sent or received; None for no log.
            pty: Pseudo terminal, if its drives are emulated in this process; otherwise None.
            run_drives: Function that runs the drives that are emulated in this process; otherwise None.
            exclusive: Whether no other program may open the port meanwhile.

        Raises:
            ConfigError: There is no such port.
            BackendError: The port cannot be opened.
        """
        self.port = port
        self.baud = baud
        self._log = log
        self._is_exclusive = exclusive

        # Drives that are emulated in this process.
        self._pty = pty
        self._run_drives = run_drives
        self._sent_bytes = 0
        self._received_bytes = 0

        # State of the port.
        # When a port that is gone was last tried; None: the port is open.
        self._last_reopen_attempt_s: float | None = None
        self._is_cut = False  # by an injected fault
        if not Path(port).exists():
            raise ConfigError(
                f"port {port!r}: there is none; plug the adapter in, and see `snakesim doctor`",
                code="bus/not-available",
            )
        try:
            self._serial = self._open()
        except IO_ERRORS as error:
            raise BackendError(
                f"{port}: cannot be opened: {error}. Is another program using it?",
                code="bus/cannot-open",
            ) from error
        self.latency_s = latency_s(port)

    def send(self, data: bytes) -> None:
        """Send a request, after discarding late responses to earlier requests.

        Nothing is sent while the port is cut or gone; a port that is gone is tried again now and then.

        Args:
            data: Encoded request packet.
        """
        if self._is_cut or not self._try_to_reopen():
            return
        self._discard_late_answers()
        self._write_log("out", data)
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            # After a long pause pyserial raises it also for data that it has written.
            if self._pty is None:
                return
        except IO_ERRORS:
            self._close_lost_port()
            return
        self._sent_bytes += len(data)
        if self._pty is not None:
            self._pty.expected_bytes = self._sent_bytes

    def receive(self, timeout_s: float) -> bytes:
        """Wait for the first byte, and return all bytes that have arrived.

        Args:
            timeout_s: Maximum duration to wait for the first byte; not used for drives that are emulated in this
                process.

        Returns:
            The received bytes; empty after the timeout, if the port is cut or gone, or if no drive that is emulated
            in this process has responded.
        """
        if self._is_cut or self._last_reopen_attempt_s is not None:
            return b""
        if self._run_drives is not None and self._pty is not None:
            self._run_drives()
            if self._received_bytes == self._pty.sent_bytes:
                return b""
            timeout_s = KERNEL_TIMEOUT_S
        try:
            data = self._read(timeout_s)
        except IO_ERRORS:
            self._close_lost_port()
            return b""
        if data:
            self._received_bytes += len(data)
            self._write_log("in", data)
        return data

    def compute_transmission_s(self, size: int) -> float:
        """Return how long this number of bytes takes on the bus."""
        return size * BITS_PER_BYTE / self.baud

    @property
    def has_immediate_responses(self) -> bool:
        """Whether no answer is late, because the drives are emulated in this process."""
        return self._run_drives is not None

    def run_emulated_drives(self) -> None:
        """Let drives that are emulated in this process run up to now."""
        if self._run_drives is not None:
            self._run_drives()

    def error(self) -> str:
        """Return why nothing can be sent now; empty if it can."""
        if self._is_cut:
            return "it is cut"
        if self._last_reopen_attempt_s is not None:
            return "it is gone: the adapter was unplugged, or its driver has failed"
        return ""

    def set_cut(self, *, begins: bool) -> None:
        """Start or end an injected fault, in which nothing is sent or received."""
        self._is_cut = begins

    def close(self) -> None:
        """Close the port, and the pseudo terminal if there is one."""
        with contextlib.suppress(OSError):
            self._serial.close()
        if self._pty is not None:
            self._pty.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _open(self) -> serial.Serial:
        port = serial.Serial(
            self.port,
            self.baud,
            timeout=0,
            write_timeout=WRITE_TIMEOUT_S,
            exclusive=self._is_exclusive,
        )
        with contextlib.suppress(
            *IO_ERRORS
        ):  # pseudo terminals and some adapters do not have this mode
            port.set_low_latency_mode(True)
        return port

    def _read(self, timeout_s: float) -> bytes:
        """Return what has arrived, or arrives in time. Now and then the kernel reports data before there is any."""
        descriptor = self._serial.fileno()
        deadline_s = time.monotonic() + timeout_s
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        while True:
            events = poll.poll(max(deadline_s - time.monotonic(), 0.0) * 1000)
            if not events:
                return b""
            _, event = events[0]
            if event & DISCONNECTED_EVENTS:
                raise OSError("disconnected")
            data = os.read(descriptor, READ_BYTES)
            if data:
                return data

    def _discard_late_answers(self) -> None:
        if self._pty is not None:
            while self._received_bytes < self._pty.sent_bytes:
                if not self.receive(KERNEL_TIMEOUT_S):
                    return
            return
        with contextlib.suppress(*IO_ERRORS):
            self._serial.reset_input_buffer()

    def _close_lost_port(self) -> None:
        self._last_reopen_attempt_s = time.monotonic()
        with contextlib.suppress(OSError):
            self._serial.close()

    def _try_to_reopen(self) -> bool:
        """Return whether the port is open. One that is gone is tried again now and then."""
        if self._last_reopen_attempt_s is None:
            return True
        now_s = time.monotonic()
        if now_s - self._last_reopen_attempt_s < REOPEN_PERIOD_S:
            return False
        self._last_reopen_attempt_s = now_s
        try:
            self._serial = self._open()
        except IO_ERRORS:
            return False
        self._last_reopen_attempt_s = None
        return True

    def _write_log(self, direction: str, data: bytes) -> None:
        if self._log is not None:
            self._log.write(
                f"({time.monotonic():.6f}) {self.port} {direction:<3} {data.hex(' ')}\n"
            )


def is_emulated(port: str) -> bool:
    """Return whether no real drive can be on a port, because it is a pseudo terminal."""
    return Path(port).resolve().parts[:3] == ("/", "dev", "pts")


def latency_s(port: str, root: Path = Path("/")) -> float:
    """Return how long an adapter may hold back what it received. root: of the file system that describes it."""
    try:
        name = Path(port).resolve().name
        return int((root / "sys/class/tty" / name / "device/latency_timer").read_text()) / 1000
    except (OSError, ValueError):
        if is_emulated(port):
            return 0.0
        return USB_LATENCY_S


def open_log(path: str, setting: str) -> TextIO | None:
    """Open the file for all bytes; None without a path.

    Args:
        path: The file; it is overwritten.
        setting: Where the scenario names it, for messages.

    Raises:
        BackendError: The file cannot be written.
    """
    if not path:
        return None
    try:
        return Path(path).open("w", encoding="utf-8")
    except OSError as error:
        raise BackendError(
            f"`{setting}` = {path!r}: {error.strerror}", code="file/not-writable"
        ) from error
