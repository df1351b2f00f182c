"""Runs `snakesim teleop` in a pseudo-terminal, in which a test types as an operator does."""

import contextlib
import os
import pty
import subprocess
import termios
import threading
from collections.abc import Iterator
from pathlib import Path

from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import SNAKESIM_COMMAND, RunningCommand, make_environment

UP = b"\x1b[A"  # arrow keys
LEFT = b"\x1b[D"


class TeleopTerminal:
    """A pseudo-terminal in which `snakesim teleop` runs."""

    def __init__(self, run: RunningCommand, cwd: Path) -> None:
        """Start the command.

        Args:
            run: The run whose robot is commanded.
            cwd: Working directory of the command.
        """
        self._fd, self._command_fd = pty.openpty()
        self._settings_before = termios.tcgetattr(self._command_fd)
        self._printed = b""
        self.process = subprocess.Popen(
            [*SNAKESIM_COMMAND, "teleop", "--endpoint", run.endpoint, "--max-speed", "0.2"],
            stdin=self._command_fd,
            stdout=self._command_fd,
            stderr=self._command_fd,
            cwd=cwd,
            env=make_environment(cwd),
            start_new_session=True,
        )
        threading.Thread(target=self._read_output, daemon=True).start()

    def _read_output(self) -> None:
        with contextlib.suppress(OSError):  # the terminal is closed
            while data := os.read(self._fd, 4096):
                self._printed += data

    def type(self, data: bytes) -> None:
        """Press keys."""
        os.write(self._fd, data)

    def wait_for_text(self, text: str) -> None:
        """Wait until the command has printed a text."""
        wait_until(lambda: text in self.printed, f"{text!r} in the terminal")

    @property
    def printed(self) -> str:
        """Everything that the command has printed."""
        return self._printed.decode(errors="replace")

    @property
    def is_restored(self) -> bool:
        """Whether the terminal has the settings that it had before the command."""
        return termios.tcgetattr(self._command_fd) == self._settings_before


@contextlib.contextmanager
def running_teleop(run: RunningCommand, cwd: Path) -> Iterator[TeleopTerminal]:
    """Run `snakesim teleop` until the end of the context, and yield its terminal once it is ready for keys."""
    terminal = TeleopTerminal(run, cwd)
    try:
        terminal.wait_for_text("SPACE: EMERGENCY STOP")
        yield terminal
    finally:
        if terminal.process.poll() is None:
            terminal.process.kill()
        terminal.process.wait(10)
