"""All terminal output of the tools: text from files and from the network cannot control the terminal.

A robot's name, the reason of an answer, a field of a file may hold escape sequences, C1 controls, line breaks or
bidirectional overrides. They are printed as JSON escapes instead, so that printed JSON stays valid.
"""

import sys
from collections.abc import Callable
from typing import Any

from snakesim_hal.errors import SnakesimError

Say = Callable[[str], None]


def printable(text: str, keep: str = "") -> str:
    """The text with every invisible character escaped as `\\u001b`; except spaces, and characters in `keep`."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() or char in keep else _escaped(char) for char in text)


def _escaped(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i]:02x}{units[i + 1]:02x}" for i in range(0, len(units), 2))


def say(line: str) -> None:
    """Print one line, at once."""
    print(printable(line), flush=True)


def say_json(value: Any, say: Say = say) -> None:
    """Print a value, such as a Struct, as one line of JSON: for scripts. NaN and infinity become null."""
    import msgspec  # most commands print none

    say(msgspec.json.encode(value).decode())


def complain(line: str) -> None:
    """Print one line to stderr."""
    print(printable(line), file=sys.stderr, flush=True)


def complain_of(error: SnakesimError, tool: str) -> None:
    """Print an error to stderr: the tool's name, and the error's own lines."""
    first, *more = error.lines
    for line in (f"{tool}: {first}", *more):
        complain(line)


def say_again(line: str, most: int, before: int) -> int:
    """Print a line, cut to `most` characters, over the previous one of `before` characters; returns its length."""
    shown = printable(line)[:most]
    print("\r" + shown.ljust(before), end="", flush=True)
    return len(shown)


def say_over(lines: list[str], before: int) -> int:
    """Print lines over the `before` lines printed last, cut to the terminal's size; returns how many they are.

    Also where the terminal is in raw mode, as for single keys.
    """
    import shutil

    size = shutil.get_terminal_size()
    shown = [printable(line)[: size.columns - 1] for line in lines[: size.lines - 1]]
    up = f"\x1b[{before}A" if before else ""
    print(up + "".join(f"\r\x1b[K{line}\r\n" for line in shown) + "\x1b[J", end="", flush=True)
    return len(shown)
