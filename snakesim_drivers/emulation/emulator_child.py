"""The process of emulated drives, as a program that controls it sees it: it reads its input, and has an output file."""

import contextlib
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from snakesim_hal.service import SERVICE_START_LIMIT_S

POLL_PERIOD_S = 0.02
STOP_TIMEOUT_S = 5.0  # after which a process that ignores SIGTERM is killed


class EmulatorChild:
    """A started process of emulated drives, in a session of its own, so that Ctrl-C does not reach it."""

    def __init__(self, command: Sequence[str], output_path: Path, environment: Mapping[str, str] | None = None) -> None:
        """Start the process.

        Args:
            command: Program and arguments.
            output_path: File of its output and errors, which is replaced.
            environment: Its environment; None for that of this process.

        Raises:
            OSError: The process cannot be started, or the file cannot be written.
        """
        self.output_path = output_path
        with output_path.open("wb") as output:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )

    @property
    def exit_code(self) -> int | None:
        """The exit code; None while the process runs."""
        return self._process.poll()

    def wait_until_ready(self, ready_text: str) -> bool:
        """Wait until a text is in the output.

        Returns:
            False if the process has ended, or SERVICE_START_LIMIT_S has passed before.
        """
        deadline_s = time.monotonic() + SERVICE_START_LIMIT_S
        while time.monotonic() < deadline_s:
            if ready_text in self.read_output():
                return True
            if self.exit_code is not None:
                return False
            time.sleep(POLL_PERIOD_S)
        return False

    def read_output(self) -> str:
        """Return the output so far; an empty text if it cannot be read."""
        with contextlib.suppress(OSError):
            return self.output_path.read_text(encoding="utf-8", errors="replace")
        return ""

    def write_line(self, text: str) -> None:
        """Write a line to the input of the process.

        Raises:
            OSError: The process has ended.
            ValueError: The process was stopped.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(f"{text}\n".encode())
        self._process.stdin.flush()

    def stop(self) -> None:
        """Terminate the process, and kill it if it does not end."""
        if self.exit_code is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
