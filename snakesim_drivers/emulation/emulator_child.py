"""The process of emulated drives, as a program that controls it sees it: it reads its input, and has an output file."""

import contextlib
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_hal.service import SERVICE_START_LIMIT_S

POLL_PERIOD_S = 0.02
STOP_TIMEOUT_S = 5.0  # after which a process that ignores SIGTERM is killed


class EmulatorChild:
    """A started process of emulated drives."""

    def __init__(self, process: subprocess.Popen[bytes], output_path: Path) -> None:
        """Take charge of a process.

        Args:
            process: A process whose input is a pipe.
            output_path: File of its output and errors.
        """
        self._process = process
        self.output_path = output_path

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


def start_python_emulator(arguments: Sequence[str], output_path: Path) -> EmulatorChild:
    """Start emulated drives in a session of their own, so that Ctrl-C does not reach them.

    Args:
        arguments: Arguments of Python, such as `-m` and a module.
        output_path: File of their output and errors, which is replaced.

    Raises:
        OSError: The process cannot be started, or the file cannot be written.
    """
    with output_path.open("wb") as output:
        process = subprocess.Popen(
            make_python_command(*arguments),
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=make_child_environment({"PYTHONUNBUFFERED": "1"}),
            start_new_session=True,
        )
    return EmulatorChild(process, output_path)
