"""A command that calibrates or jogs joints, which runs beside the console, in a pseudo-terminal of its own.

So the page has the texts, the checks and the dead-man's switch of the command. If the console ends, the terminal is
closed, and the command ends as in any terminal that is closed. If the console hangs, it sends no keys, and a joint that
is jogged stops.
"""

import contextlib
import os
import pty
import subprocess
import termios
import threading
from collections import deque
from collections.abc import Sequence

from snakesim_hal.base.process import make_child_environment, make_python_command

MAX_LINES = 14  # of output, so that the buttons below it stay in sight
MAX_LINE_CHARACTERS = 300
LOCAL_FLAGS = 3  # index of the local flags in what `termios.tcgetattr` returns

# Keys of the command.
ENTER = b"\n"
FORWARDS = b"+"
BACKWARDS = b"-"


def format_command_name(step_name: str) -> str:
    """Return the name of the command that runs a step, without the word `snakesim`."""
    return "robot jog" if step_name == "jog" else f"robot calibrate {step_name}"


class JointStep:
    """One run of the command. A thread of its own reads the output; every method may be called from any thread."""

    def __init__(self, command_words: Sequence[str]) -> None:
        """Start the command of a step in a pseudo-terminal, and a thread that reads its output.

        Args:
            command_words: Name of the step, such as `zero` or `jog`, and the arguments of its command.
        """
        self.step_name = command_words[0]
        self._lines: deque[str] = deque(maxlen=MAX_LINES)
        self._lock = threading.Lock()  # of `_lines` and `_terminal_fd`
        self._terminal_fd, command_terminal = pty.openpty()
        try:
            os.set_blocking(self._terminal_fd, False)
            _disable_echo(command_terminal)
            self._process = _start_command(command_words, command_terminal)
        except BaseException:
            os.close(self._terminal_fd)
            raise
        finally:
            os.close(command_terminal)
        self._reader_thread = threading.Thread(
            target=self._read_output, name="joint step", daemon=True
        )
        self._reader_thread.start()

    @property
    def is_running(self) -> bool:
        """Whether the command may still print something."""
        return self._reader_thread.is_alive()

    @property
    def lines(self) -> list[str]:
        """The newest lines of output, oldest first."""
        with self._lock:
            return list(self._lines)

    def press_key(self, key: bytes) -> None:
        """Send a key to the command without waiting.

        A key that the command cannot take now is lost, because a key must not count later.
        """
        with self._lock, contextlib.suppress(OSError):  # the terminal is full, or closed
            os.write(self._terminal_fd, key)

    def terminate(self) -> None:
        """End the command as Ctrl-C does: a joint that is jogged is disarmed, and a file is not written."""
        with contextlib.suppress(ProcessLookupError):
            self._process.terminate()

    def _read_output(self) -> None:
        assert self._process.stdout is not None
        try:
            with self._process.stdout as output:
                for line in output:
                    self._add_line(line.rstrip("\n")[:MAX_LINE_CHARACTERS])
        except BaseException:  # a step whose output cannot be shown must not go on
            self.terminate()
            raise
        finally:
            exit_code = self._process.wait()
            self._add_line("done" if exit_code == 0 else f"ended ({exit_code})")
            with self._lock:
                os.close(self._terminal_fd)
                # A key that is sent now fails, rather than going to another file.
                self._terminal_fd = -1

    def _add_line(self, line: str) -> None:
        with self._lock:
            self._lines.append(line)


def _disable_echo(terminal: int) -> None:
    """Keep a terminal from printing the keys that are sent to it."""
    attributes = termios.tcgetattr(terminal)
    attributes[LOCAL_FLAGS] &= ~termios.ECHO
    termios.tcsetattr(terminal, termios.TCSANOW, attributes)


def _start_command(command_words: Sequence[str], terminal: int) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        make_python_command(
            "-m",
            "snakesim_operator",
            *format_command_name(command_words[0]).split(),
            *command_words[1:],
        ),
        env=make_child_environment(),
        stdin=terminal,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
