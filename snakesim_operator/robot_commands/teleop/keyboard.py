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
# Keys in one reading; teleop reads 20 times a second, and a keyboard repeats up to 50 times a second.
MAX_KEYS_PER_READ = 8
RATE_WINDOW_S = 0.5
MAX_KEY_RATE_HZ = 60.0  # more keys a second than any keyboard repeats
MAX_UNREAD_DURATION_S = 0.5  # between two readings; keys may have waited for that long
NO_TERMINAL_MESSAGE = (
    "teleop reads keys, and stdin is no terminal; start it in one, or give --joystick"
)
INPUT_FLAGS, LOCAL_FLAGS, CONTROL_CHARACTERS = 0, 3, 6  # indices of what termios.tcgetattr returns


class KeyTiming:
    """Detects keys that may have waited before they were read. It does no input or output itself.

    Keys are late if more of them arrive together than a keyboard repeats, or if the program has not read for a while.
    A single key that a network has delayed looks like one that was pressed just now, so it is not recognized.
    """

    def __init__(self) -> None:
        self._last_read_s: float | None = None  # None: no reading yet
        self._key_times_s: deque[float] = deque()  # of the keys of the last RATE_WINDOW_S

    def record_read(self, key_count: int, now_s: float) -> bool:
        """Record a reading of the keyboard, and return whether its keys may be stale.

        After a stall, keys that were pressed meanwhile arrive together. So more keys than a keyboard sends, or any key
        after a long pause between readings, may be stale.

        Call this for each reading, also for a reading without keys.

        Args:
            key_count: Number of keys in this reading.
            now_s: Monotonic time of this reading.
        """
        time_since_last_read_s = math.inf
        if self._last_read_s is not None:
            time_since_last_read_s = now_s - self._last_read_s
        self._last_read_s = now_s
        while self._key_times_s and now_s - self._key_times_s[0] > RATE_WINDOW_S:
            self._key_times_s.popleft()
        self._key_times_s.extend([now_s] * key_count)
        if key_count == 0:
            return False
        has_too_many_keys = (
            key_count > MAX_KEYS_PER_READ
            or len(self._key_times_s) > MAX_KEY_RATE_HZ * RATE_WINDOW_S
        )
        return has_too_many_keys or time_since_last_read_s > MAX_UNREAD_DURATION_S


class KeyReader:
    """Reads stdin key by key, without echo. Ctrl-C works; Ctrl-Z does not, because it would leave the robot moving."""

    def __init__(self, no_terminal_message: str = NO_TERMINAL_MESSAGE) -> None:
        """Store the current settings of the terminal, which are restored at the end.

        Args:
            no_terminal_message: Text of the error if stdin is not a terminal.

        Raises:
            ConfigError: Stdin is not a terminal.
        """
        self._file_descriptor = sys.stdin.fileno()
        if not os.isatty(self._file_descriptor):
            raise ConfigError(no_terminal_message, code="command/invalid-option")
        self._initial_settings = termios.tcgetattr(self._file_descriptor)
        self.is_gone = False  # the terminal was closed
        self.has_late_keys = False  # the keys of the last reading may be old
        self._timing = KeyTiming()

    def __enter__(self) -> Self:
        settings = termios.tcgetattr(self._file_descriptor)
        # Ctrl-S would pause output, and with it this program and its stop keys.
        settings[INPUT_FLAGS] &= ~termios.IXON
        settings[LOCAL_FLAGS] &= ~(termios.ICANON | termios.ECHO)
        characters = settings[CONTROL_CHARACTERS]
        characters[termios.VMIN] = 1
        characters[termios.VTIME] = 0
        characters[termios.VSUSP] = b"\0"  # disables Ctrl-Z
        termios.tcsetattr(self._file_descriptor, termios.TCSADRAIN, settings)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            termios.tcsetattr(self._file_descriptor, termios.TCSADRAIN, self._initial_settings)
        except termios.error:  # the terminal was closed
            self.is_gone = True

    def read_keys(self, timeout_s: float) -> list[str]:
        """Wait for keys, and return them. `has_late_keys` is then whether they may be old.

        Args:
            timeout_s: Time to wait for the first key.

        Returns:
            Each key as `up`, `down`, `left`, `right` or its character; empty if none was pressed in time.
        """
        readable, _, _ = select.select([self._file_descriptor], [], [], timeout_s)
        pressed = self._read_keys() if readable else []
        self.has_late_keys = self._timing.record_read(len(pressed), time.monotonic())
        return pressed

    def _read_keys(self) -> list[str]:
        try:
            data = os.read(self._file_descriptor, MAX_BYTES)
        except OSError:
            data = b""
        self.is_gone = not data
        return _split_keys(data)


def _split_keys(data: bytes) -> list[str]:
    """Return the keys in bytes from the terminal. Escape sequences of three bytes that are no arrow are left out."""
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
