"""Single keys from the terminal, which is always given back as it was."""

import os
import select
import sys
import termios
from typing import Self

from snakesim_hal.errors import ConfigError

KEYS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}  # after ESC [ or ESC O
MAX_BYTES = 1024  # a paste, or a key that repeats; all of it is read, and the newest end of it counts
WANTED = "teleop reads keys, and stdin is no terminal; start it in one, or give --joystick"


class Keyboard:
    """stdin, a key at a time, without echo. Ctrl-C works; Ctrl-Z does not, because it would leave the robot moving."""

    def __init__(self, wanted: str = WANTED) -> None:
        """Raises ConfigError, with what is wanted, when stdin is no terminal."""
        self._handle = sys.stdin.fileno()
        if not os.isatty(self._handle):
            raise ConfigError(wanted)
        self._before = termios.tcgetattr(self._handle)
        self.gone = False  # the terminal was closed

    def __enter__(self) -> Self:
        mode = termios.tcgetattr(self._handle)
        mode[0] &= ~termios.IXON  # Ctrl-S would stop output, and with it this program, the emergency stop too
        mode[3] &= ~(termios.ICANON | termios.ECHO)
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
        mode[6][termios.VSUSP] = b"\0"
        termios.tcsetattr(self._handle, termios.TCSADRAIN, mode)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            termios.tcsetattr(self._handle, termios.TCSADRAIN, self._before)
        except termios.error:  # it was closed
            self.gone = True

    def keys(self, wait_s: float) -> list[str]:
        """Keys pressed, at the latest after a time: `up`, `down`, `left`, `right`, or the character."""
        ready, _, _ = select.select([self._handle], [], [], wait_s)
        if not ready:
            return []
        try:
            data = os.read(self._handle, MAX_BYTES)
        except OSError:
            data = b""
        self.gone = not data
        return _split(data)


def _split(data: bytes) -> list[str]:
    found: list[str] = []
    while data:
        if data[:2] in (b"\x1b[", b"\x1bO") and len(data) > 2:
            if data[2:3] in KEYS:
                found.append(KEYS[data[2:3]])
            data = data[3:]
            continue
        found.append(chr(data[0]))
        data = data[1:]
    return found
