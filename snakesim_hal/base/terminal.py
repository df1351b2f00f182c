"""All terminal output of the tools: text from files and from the network cannot control the terminal.

A robot's name, the reason of an answer, a field of a file may hold escape sequences, C1 controls, line breaks or
bidirectional overrides. They are printed as JSON escapes instead, so that printed JSON stays valid.
"""

import io
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO

from snakesim_hal.base.errors import ConfigError, SnakesimError

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


@contextmanager
def output_may_fail() -> Iterator[None]:
    """Inside, a failed write ends nothing, because a robot moves: a closed pipe or terminal, a full disk."""
    with redirect_stdout(_FailSafeStream(sys.stdout)), redirect_stderr(_FailSafeStream(sys.stderr)):
        yield


class _FailSafeStream(io.TextIOBase):
    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except UnicodeEncodeError:
            return self.write(text.encode("ascii", "backslashreplace").decode())
        except OSError:
            discard(self._stream)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            discard(self._stream)

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()


def discard(stream: TextIO) -> None:
    """From here on what is printed is thrown away, what is still in the buffer, too."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


def say_json(value: Any, say: Say = say) -> None:
    """Print a value, such as a Struct, as one line of JSON: for scripts. NaN and infinity become null."""
    import msgspec  # most commands print none

    say(msgspec.json.encode(value).decode())


def print_stderr(line: str) -> None:
    """Print one line to stderr."""
    print(printable(line), file=sys.stderr, flush=True)


def exit_code(tool: str, act: Callable[[], int]) -> int:
    """Of a program: what it returns; else the error is told, 2 for wrong input, 1 for any other."""
    try:
        return act()
    except SnakesimError as error:
        report_error(error, tool)
        return 2 if isinstance(error, ConfigError) else 1


def report_error(error: SnakesimError, tool: str) -> None:
    """Print an error to stderr: the tool's name, and the error's own lines."""
    first, *more = error.lines
    for line in (f"{tool}: {first}", *more):
        print_stderr(line)


def aligned(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """Rows, which are texts by column, as lines with a heading."""
    every = [dict(zip(columns, columns, strict=True)), *rows]
    widths = [max(len(row[column]) for row in every) for column in columns]
    for row in every:
        yield "  ".join(f"{row[name]:<{width}}" for name, width in zip(columns, widths, strict=True)).rstrip()


def overwrite_line(line: str, most: int, before: int) -> int:
    """Print a line, cut to `most` characters, over the previous one of `before` characters; returns its length."""
    shown = printable(line)[:most]
    print("\r" + shown.ljust(before), end="", flush=True)
    return len(shown)


def overwrite_lines(lines: list[str], before: int) -> int:
    """Print lines over the `before` lines printed last, cut to the terminal's size; returns how many they are.

    Also where the terminal is in raw mode, as for single keys.
    """
    import shutil

    size = shutil.get_terminal_size()
    shown = [printable(line)[: size.columns - 1] for line in lines[: size.lines - 1]]
    up = f"\x1b[{before}A" if before else ""
    print(up + "".join(f"\r\x1b[K{line}\r\n" for line in shown) + "\x1b[J", end="", flush=True)
    return len(shown)
