"""A `snakesim joints` command that runs beside the console, in a terminal of its own: what it says, and keys for it.

So the page has the command's words, checks and dead-man's switch. If the console ends, that terminal is gone, and the
command ends as in one that was closed; a console that hangs types nothing, and a joint that is jogged stands.
"""

import contextlib
import os
import pty
import subprocess
import termios
import threading
from collections import deque
from collections.abc import Sequence

from snakesim_hal.base.process import child_environment, python_command

LINES = 14
ENTER, FORWARDS, BACKWARDS = b"\n", b"+", b"-"


class JointStep:
    """One run of it."""

    def __init__(self, words: Sequence[str]) -> None:
        """words: what follows `snakesim joints`."""
        self.verb, self._lock = words[0], threading.Lock()
        self._lines: deque[str] = deque(maxlen=LINES)
        self._terminal, theirs = pty.openpty()
        os.set_blocking(self._terminal, False)
        mode = termios.tcgetattr(theirs)
        mode[3] &= ~termios.ECHO
        termios.tcsetattr(theirs, termios.TCSANOW, mode)
        try:
            self._process = subprocess.Popen(
                python_command("-m", "snakesim_operator", "joints", *words),
                env=child_environment(),
                stdin=theirs,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            )
        except OSError:
            os.close(self._terminal)
            raise
        finally:
            os.close(theirs)
        self._reader = threading.Thread(target=self._read, name="joint step", daemon=True)
        self._reader.start()

    @property
    def runs(self) -> bool:
        """Whether it has more to say."""
        return self._reader.is_alive()

    @property
    def lines(self) -> list[str]:
        """The newest that it has said, oldest first."""
        with self._lock:
            return list(self._lines)

    def press(self, key: bytes) -> None:
        """Type a key. What nobody takes in is lost: a key must not count later."""
        with self._lock, contextlib.suppress(OSError):  # full, or over
            os.write(self._terminal, key)

    def end(self) -> None:
        """End it, as Ctrl-C does: a joint that is jogged is disarmed, a file is not written."""
        with contextlib.suppress(ProcessLookupError):
            self._process.terminate()

    def _read(self) -> None:
        assert self._process.stdout is not None
        try:
            with self._process.stdout as said:
                for line in said:
                    with self._lock:
                        self._lines.append(line.rstrip("\n")[:300])
        except BaseException:  # its output cannot be read: a step that nobody sees must not go on
            self.end()
            raise
        finally:
            code = self._process.wait()
            with self._lock:
                self._lines.append("done" if code == 0 else f"ended ({code})")
                os.close(self._terminal)
                self._terminal = -1
