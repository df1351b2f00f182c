"""Read and write text files safely: bounded in size, depth and time, and never a pipe, a device or a symlink.

Every failure is one ConfigError that names the file and the reason.
"""

import codecs
import contextlib
import itertools
import json
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from snakesim_hal.base.atomic_write import replaced, write_whole
from snakesim_hal.base.errors import ConfigError, nearest

MB = 1024 * 1024
MAX_BYTES, MAX_TOML = 8 * MB, 2 * MB  # a route of 20,000 way-points has 1.8 MB as formatted JSON, 0.8 MB as TOML
MAX_LISTED = 1000  # files of a folder that are looked at for one that may be meant
MAX_DEPTH = 16  # sections within sections; a run's configuration has 6
_KEY = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w-])(?:{_KEY}[ \t]*+\.[ \t]*+){{{MAX_DEPTH}}}")  # tomllib takes quadratic time for it
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFLNK: "a symbolic link",
}


def read_text(path: Path) -> str:
    """A whole file as text. Raises ConfigError. A UTF-8 byte-order mark is skipped."""
    data = read_bytes(path)
    if data.startswith(_UTF16) or b"\0" in data:
        raise ConfigError(f"{path}: is UTF-16 text, or not text; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: is not UTF-8 text: byte 0x{data[error.start]:02x} at {error.start}; save it as UTF-8"
        ) from None


def read_bytes(path: Path) -> bytes:
    """A whole file. Raises ConfigError."""
    try:
        mode = path.stat().st_mode
        data = b""
        if stat.S_ISREG(mode):  # opening a device may have side effects, opening a pipe blocks
            with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
                data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file{_instead_of(path)}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # a NUL in the name
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    _check_plain(path, mode)
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path}: is larger than {MAX_BYTES // MB} MB, the limit of a settings file")
    return data


def _instead_of(path: Path) -> str:
    """What may be meant by the path of a file that is not there."""
    try:
        there = sorted(entry.name for entry in itertools.islice(path.parent.iterdir(), MAX_LISTED))
    except OSError as error:
        return f"; its folder {path.parent} cannot be read: {error.strerror}"
    close = nearest(path.name, there)
    if close:
        return f"; did you mean {path.parent / close}?"
    if not path.suffix:
        return ""
    alike = [name for name in there if name.endswith(path.suffix)][:8]
    return f"; in {path.parent.absolute()} " + (f"are {', '.join(alike)}" if alike else f"is no file *{path.suffix}")


def _check_plain(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise ConfigError(f"{path}: is {kind}, not a file; name a file")


def parse_json(text: str, source: str) -> Any:
    """A JSON text. Raises ConfigError."""
    return _parsed(text, source, json.loads, "JSON")


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """A TOML text. Raises ConfigError."""
    if len(text) > MAX_TOML:
        raise ConfigError(f"{source}: is larger than {MAX_TOML // MB} MB; make it smaller, or write it as JSON")
    if deep := _DEEP_KEY.search(text):
        raise ConfigError(f"{source}: key `{deep[0][:40]}...` has more than {MAX_DEPTH} parts")
    return _parsed(text, source, tomllib.loads, "TOML")


def _parsed(text: str, source: str, parse: Callable[[str], Any], language: str) -> Any:
    try:
        value = parse(text)
    except RecursionError:
        raise ConfigError(f"{source}: not valid {language}: nested deeper than {MAX_DEPTH} levels") from None
    except ValueError as error:  # the parser's own; or a number of thousands of digits
        raise ConfigError(f"{source}: not valid {language}: {error}") from None
    _check_depth(value, source)
    return value


def check_brackets(text: str, source: str) -> None:
    """For a text that another library parses: Zenoh overflows its stack on deep nesting. Raises ConfigError."""
    depth = 0
    for bracket in re.findall(r"[][{}]", text):
        depth += 1 if bracket in "[{" else -1
        if depth > MAX_DEPTH:
            raise ConfigError(f"{source}: is nested deeper than {MAX_DEPTH} levels")


def _check_depth(value: Any, source: str) -> None:
    """After this check, code that walks through the values may recurse once a level."""
    level: list[Any] = [value]
    for _ in range(MAX_DEPTH):
        inner: list[Any] = []
        for one in level:
            if isinstance(one, dict):
                inner += one.values()
            elif isinstance(one, list):
                inner += one
        level = [one for one in inner if isinstance(one, dict | list)]
        if not level:
            return
    raise ConfigError(f"{source}: is nested deeper than {MAX_DEPTH} levels")


@contextlib.contextmanager
def exported(path: Path) -> Iterator[Path]:
    """Yield the path where an export is written, file or folder; it becomes `path` when it is whole.

    Through a symbolic link, the file that it leads to is replaced.

    Raises:
        ConfigError: It cannot be written, for the disk is full for example. No half of it is left then.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(Path(os.path.realpath(path))) as partial:
            yield partial
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {_reason(error)}. What was there before is unchanged. Make room, or choose "
            "another place with --out"
        ) from None


def _reason(error: OSError) -> str:
    """Return why it failed; some libraries raise it with a text of their own, and no more."""
    number = error.errno if error.errno is not None else re.search(r"errno (\d+)", str(error))
    if isinstance(number, re.Match):
        number = int(number[1])
    return str(error) if number is None else os.strerror(number)


def write_text(path: Path, text: str, encoding: str = "utf-8") -> None:
    """Write a file atomically, or leave it unchanged. Raises ConfigError; also for a link or a device."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            _check_plain(path, path.lstat().st_mode)
        write_whole(path, text.encode(encoding))
    except OSError as error:
        why = "its folder is a file" if isinstance(error, FileExistsError) else error.strerror
        raise ConfigError(f"{path}: cannot be written: {why}") from None
