"""Single keys from the terminal, which is always given back as it was.

A terminal gives keys without a time. Behind a network that stalls, or in a program that was stopped, they wait, and
come all at once when it goes on. Such keys are marked as late, by what no keyboard does: `KeyTiming`.
"""

import math
import os
import select
import sys
import termios
import time
from collections import deque
from typing import Self

from snakesim_hal.base.errors import ConfigError

KEYS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}  # after ESC [ or ESC O
MAX_BYTES = 1024  # a paste, or a key that repeats; all of it is read, and the newest end of it counts
MAX_AT_ONCE = 8  # keys in one look; teleop looks 20 times a second, and a keyboard repeats up to 50 times
WINDOW_S, MAX_KEYS_HZ = 0.5, 60.0  # more keys a second than any keyboard repeats
MAX_UNREAD_S = 0.5  # between two looks: keys may have waited for as long
WANTED = "teleop reads keys, and stdin is no terminal; start it in one, or give --joystick"


class KeyTiming:
    """Whether keys may have waited before they were read. Pure.

    They have if more came together than a keyboard repeats, or if nobody has read for a while: then they may be as old
    as that. A single key that a network has delayed cannot be told from one that was pressed just now.
    """

    def __init__(self) -> None:
        self._read_s: float | None = None  # when keys were looked for last; None: never
        self._came_s: deque[float] = deque()  # when the keys of the last WINDOW_S came

    def are_late(self, count: int, now_s: float) -> bool:
        """Return whether keys that are read now may be old. count: how many; call it for each look, also for none."""
        unread_s = math.inf if self._read_s is None else now_s - self._read_s
        self._read_s = now_s
        while self._came_s and now_s - self._came_s[0] > WINDOW_S:
            self._came_s.popleft()
        self._came_s.extend([now_s] * count)
        too_many = count > MAX_AT_ONCE or len(self._came_s) > MAX_KEYS_HZ * WINDOW_S
        return count > 0 and (too_many or unread_s > MAX_UNREAD_S)


class Keyboard:
    """stdin, a key at a time, without echo. Ctrl-C works; Ctrl-Z does not, because it would leave the robot moving."""

    def __init__(self, wanted: str = WANTED) -> None:
        """Raises ConfigError, with what is wanted, when stdin is no terminal."""
        self._handle = sys.stdin.fileno()
        if not os.isatty(self._handle):
            raise ConfigError(wanted, code="command/invalid-option")
        self._before = termios.tcgetattr(self._handle)
        self.gone = False  # the terminal was closed
        self.late = False  # whether the keys of the last look may be old
        self._timing = KeyTiming()

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
        found = self._read() if ready else []
        self.late = self._timing.are_late(len(found), time.monotonic())
        return found

    def _read(self) -> list[str]:
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
