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

PrintLine = Callable[[str], None]


def escape_invisible(text: str, keep: str = "") -> str:
    """Return the text with every invisible character escaped as `\\u001b`; except spaces, and characters in `keep`."""
    if text.isprintable():
        return text
    characters: list[str] = []
    for char in text:
        visible = char.isprintable() or char in keep
        characters.append(char if visible else _escape(char))
    return "".join(characters)


def _escape(char: str) -> str:
    """Return a character as JSON escapes, one for each of its UTF-16 units."""
    units = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i]:02x}{units[i + 1]:02x}" for i in range(0, len(units), 2))


def print_line(line: str) -> None:
    """Print one line, at once."""
    print(escape_invisible(line), flush=True)


def discard_line(_line: str) -> None:
    """Print nothing, where a function wants a `PrintLine`."""


@contextmanager
def tolerate_failed_output() -> Iterator[None]:
    """Ignore failed writes to stdout and stderr in this context, such as to a closed pipe, because a robot moves."""
    with redirect_stdout(_FailSafeStream(sys.stdout)), redirect_stderr(_FailSafeStream(sys.stderr)):
        yield


class _FailSafeStream(io.TextIOBase):
    """A text stream whose writes never fail: after the first failure its output is discarded."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except UnicodeEncodeError:
            return self.write(text.encode("ascii", "backslashreplace").decode())
        except OSError:
            discard_output(self._stream)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            discard_output(self._stream)

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()


def discard_output(stream: TextIO) -> None:
    """Redirect a stream to /dev/null, including the text that is still in its buffer."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


def print_json(value: Any, print_text: PrintLine = print_line) -> None:
    """Print a value, such as a Struct, as one line of JSON: for scripts. NaN and infinity become null."""
    import msgspec  # most commands print none

    print_text(msgspec.json.encode(value).decode())


def print_stderr(line: str) -> None:
    """Print one line to stderr."""
    print(escape_invisible(line), file=sys.stderr, flush=True)


def run_tool(tool: str, run: Callable[[], int], *, as_json: bool = False) -> int:
    """Run a program and return its exit code. An error is printed: 2 means wrong input, 1 any other error.

    Args:
        tool: Name of the program, which its errors begin with.
        run: Function that runs the program, and returns the exit code.
        as_json: Whether to print an error also as one line of JSON on stdout.
    """
    try:
        return run()
    except SnakesimError as error:
        report_error(error, tool)
        if as_json:
            print_json({"error": {"code": error.code, "message": str(error)}})
        return 2 if isinstance(error, ConfigError) else 1


def report_error(error: SnakesimError, tool: str) -> None:
    """Print an error to stderr: the tool's name, the error's first line and its code; then its further lines."""
    first, *more = error.lines
    for line in (f"{tool}: {first} [{error.code}]", *more):
        print_stderr(line)


def align_columns(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """Yield the lines of a table with a heading. Each row has a text for each column."""
    heading = {column: column for column in columns}
    lines = [heading, *rows]
    widths = {column: max(len(line[column]) for line in lines) for column in columns}
    for line in lines:
        cells = [line[column].ljust(widths[column]) for column in columns]
        yield "  ".join(cells).rstrip()


def overwrite_line(line: str, max_length: int, previous_length: int) -> int:
    """Print a line over the previous one, and return its length.

    Args:
        line: New line.
        max_length: Maximum number of characters. The rest is cut off.
        previous_length: Length of the previous line, which is overwritten.
    """
    shown = escape_invisible(line)[:max_length]
    print("\r" + shown.ljust(previous_length), end="", flush=True)
    return len(shown)


def overwrite_lines(lines: list[str], previous_count: int) -> int:
    """Print lines over the lines that were printed last, cut to the terminal's size, and return their number.

    It works in raw mode too, as for single keys.
    """
    import shutil

    size = shutil.get_terminal_size()
    shown = [escape_invisible(line)[: size.columns - 1] for line in lines[: size.lines - 1]]
    text = ""
    if previous_count:
        text = f"\x1b[{previous_count}A"  # moves the cursor up
    for line in shown:
        text += f"\r\x1b[K{line}\r\n"  # clears the line and writes it
    text += "\x1b[J"  # clears what is below
    print(text, end="", flush=True)
    return len(shown)
