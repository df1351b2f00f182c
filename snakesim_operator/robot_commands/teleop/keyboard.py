"""Reads single keys from the terminal, and restores the terminal's settings at the end.

Keys from a terminal have no timestamp. While a network stalls, or the program is stopped, keys wait; when it continues,
all of them arrive at once. `KeyTiming` recognizes such late keys, because no keyboard sends keys like that.
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

ESCAPE_PREFIXES = (b"\x1b[", b"\x1bO")  # the first two bytes of an arrow key
ARROW_KEYS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}  # by the third byte
MAX_BYTES = 1024  # in one reading: a pasted text, or a key that repeats
MAX_AT_ONCE = 8  # keys in one reading; teleop reads 20 times a second, and a keyboard repeats up to 50 times a second
RATE_WINDOW_S = 0.5
MAX_KEYS_HZ = 60.0  # more keys a second than any keyboard repeats
MAX_UNREAD_S = 0.5  # between two readings; keys may have waited for that long
NO_TERMINAL = "teleop reads keys, and stdin is no terminal; start it in one, or give --joystick"
INPUT_FLAGS, LOCAL_FLAGS, CONTROL_CHARACTERS = 0, 3, 6  # indices of what termios.tcgetattr returns


class KeyTiming:
    """Decides whether keys may have waited before they were read. Has no side effects.

    Keys are late if more of them arrive together than a keyboard repeats, or if the program has not read for a while.
    A single key that a network has delayed looks like one that was pressed just now, so it is not recognized.
    """

    def __init__(self) -> None:
        self._last_reading_s: float | None = None  # None: no reading yet
        self._arrivals_s: deque[float] = deque()  # of the keys of the last RATE_WINDOW_S

    def are_late(self, count: int, now_s: float) -> bool:
        """Return whether the keys of this reading may be old. Call it for each reading, also for one without keys.

        Args:
            count: number of keys in this reading.
            now_s: time of this reading, of the monotonic clock.
        """
        unread_s = math.inf
        if self._last_reading_s is not None:
            unread_s = now_s - self._last_reading_s
        self._last_reading_s = now_s
        while self._arrivals_s and now_s - self._arrivals_s[0] > RATE_WINDOW_S:
            self._arrivals_s.popleft()
        self._arrivals_s.extend([now_s] * count)
        if count == 0:
            return False
        too_many = count > MAX_AT_ONCE or len(self._arrivals_s) > MAX_KEYS_HZ * RATE_WINDOW_S
        return too_many or unread_s > MAX_UNREAD_S


class Keyboard:
    """Reads stdin key by key, without echo. Ctrl-C works; Ctrl-Z does not, because it would leave the robot moving."""

    def __init__(self, no_terminal: str = NO_TERMINAL) -> None:
        """Remember the terminal's settings.

        Args:
            no_terminal: text of the error for a stdin that is no terminal.

        Raises:
            ConfigError: stdin is no terminal.
        """
        self._handle = sys.stdin.fileno()
        if not os.isatty(self._handle):
            raise ConfigError(no_terminal, code="command/invalid-option")
        self._initial_settings = termios.tcgetattr(self._handle)
        self.gone = False  # the terminal was closed
        self.late = False  # the keys of the last reading may be old
        self._timing = KeyTiming()

    def __enter__(self) -> Self:
        settings = termios.tcgetattr(self._handle)
        settings[INPUT_FLAGS] &= ~termios.IXON  # Ctrl-S would pause output, and with it this program and its stop keys
        settings[LOCAL_FLAGS] &= ~(termios.ICANON | termios.ECHO)
        characters = settings[CONTROL_CHARACTERS]
        characters[termios.VMIN] = 1
        characters[termios.VTIME] = 0
        characters[termios.VSUSP] = b"\0"  # disables Ctrl-Z
        termios.tcsetattr(self._handle, termios.TCSADRAIN, settings)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            termios.tcsetattr(self._handle, termios.TCSADRAIN, self._initial_settings)
        except termios.error:  # the terminal was closed
            self.gone = True

    def keys(self, wait_s: float) -> list[str]:
        """Wait for keys, and return them as `up`, `down`, `left`, `right`, or the character.

        Args:
            wait_s: how long to wait for the first key; without one, the list is empty.
        """
        readable, _, _ = select.select([self._handle], [], [], wait_s)
        pressed = self._read_keys() if readable else []
        self.late = self._timing.are_late(len(pressed), time.monotonic())
        return pressed

    def _read_keys(self) -> list[str]:
        try:
            data = os.read(self._handle, MAX_BYTES)
        except OSError:
            data = b""
        self.gone = not data
        return _split_keys(data)


def _split_keys(data: bytes) -> list[str]:
    """Return the keys in the terminal's bytes; other escape sequences of three bytes are left out."""
    pressed: list[str] = []
    while data:
        is_escape_sequence = data[:2] in ESCAPE_PREFIXES and len(data) > 2
        if is_escape_sequence:
            code = data[2:3]
            if code in ARROW_KEYS:
                pressed.append(ARROW_KEYS[code])
            data = data[3:]
        else:
            pressed.append(chr(data[0]))
            data = data[1:]
    return pressed
