"""An operator at the keyboard of `snakesim teleop`."""

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

UP, LEFT = b"\x1b[A", b"\x1b[D"


class TeleopTerminal:
    """A pseudo-terminal with teleop in it."""

    def __init__(self, run: RunningCommand, cwd: Path) -> None:
        self.ours, self._theirs = pty.openpty()
        self.before = termios.tcgetattr(self._theirs)
        self._printed = b""
        self.process = subprocess.Popen(
            [*SNAKESIM_COMMAND, "teleop", "--endpoint", run.endpoint, "--max-speed", "0.2"],
            stdin=self._theirs,
            stdout=self._theirs,
            stderr=self._theirs,
            cwd=cwd,
            env=make_environment(cwd),
            start_new_session=True,
        )
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while data := os.read(self.ours, 4096):
                self._printed += data

    def type(self, data: bytes) -> None:
        os.write(self.ours, data)

    def shows(self, words: str) -> None:
        wait_until(lambda: words in self.printed, f"{words!r} in the terminal")

    @property
    def printed(self) -> str:
        return self._printed.decode(errors="replace")

    @property
    def given_back(self) -> bool:
        """Whether the terminal is as it was before."""
        return termios.tcgetattr(self._theirs) == self.before


@contextlib.contextmanager
def at_the_keyboard(run: RunningCommand, cwd: Path) -> Iterator[TeleopTerminal]:
    terminal = TeleopTerminal(run, cwd)
    try:
        terminal.shows("SPACE: EMERGENCY STOP")
        yield terminal
    finally:
        if terminal.process.poll() is None:
            terminal.process.kill()
        terminal.process.wait(10)
