"""Everything that a tool prints goes through here: text from files and from the network cannot steer the terminal.

A robot's name, the reason of an answer, a field of a file may hold escape sequences, C1 controls, line breaks or
bidirectional overrides. They are shown as the escapes of JSON instead, so that a printed JSON text stays one.
"""

import sys
from collections.abc import Callable

from snakesim_hal.errors import SnakesimError

Say = Callable[[str], None]


def printable(text: str, keep: str = "") -> str:
    """The text with every character that is not visible written as `\\u001b`; a space stays, and what is in `keep`."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() or char in keep else _escaped(char) for char in text)


def _escaped(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i]:02x}{units[i + 1]:02x}" for i in range(0, len(units), 2))


def say(line: str) -> None:
    """Print one line, at once."""
    print(printable(line), flush=True)


def complain(line: str) -> None:
    """Print one line to stderr."""
    print(printable(line), file=sys.stderr, flush=True)


def complain_of(error: SnakesimError, tool: str) -> None:
    """Print an error to stderr: the tool's name, and the error's own lines."""
    first, *more = error.lines
    for line in (f"{tool}: {first}", *more):
        complain(line)


def say_again(line: str, most: int, before: int) -> int:
    """Print a line, cut to `most` characters, over the one before, which had `before`; returns how many it has."""
    shown = printable(line)[:most]
    print("\r" + shown.ljust(before), end="", flush=True)
    return len(shown)
