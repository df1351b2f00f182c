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

from snakesim_hal.base.atomic_write import replace_atomically, write_atomically
from snakesim_hal.base.errors import ConfigError, find_nearest_word

MB = 1024 * 1024

# A route of 20,000 waypoints has 1.8 MB as formatted JSON, and 0.8 MB as TOML.
MAX_FILE_BYTES = 8 * MB
MAX_TOML_CHARACTERS = 2 * MB

MAX_SEARCHED_FILES = 1000  # files of a folder that are searched for a similar name
MAX_SUGGESTED_FILES = 8  # files that an error lists
MAX_DEPTH = 16  # sections within sections; a run's configuration has 6
_KEY_PATTERN = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
# A key of too many parts; tomllib would need quadratic time for it.
_TOO_DEEP_KEY_PATTERN = re.compile(rf"(?<![\w-])(?:{_KEY_PATTERN}[ \t]*+\.[ \t]*+){{{MAX_DEPTH}}}")
_UTF16_BOMS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_FILE_TYPE_NAMES = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFLNK: "a symbolic link",
}


def read_text(path: Path) -> str:
    """Return a whole file as text, without a byte-order mark. Raises ConfigError if it is not UTF-8 text."""
    data = read_bytes(path)
    if data.startswith(_UTF16_BOMS) or b"\0" in data:
        raise ConfigError(
            f"{path}: is UTF-16 text, or not text; save it as UTF-8", code="file/invalid-syntax"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: is not UTF-8 text: byte 0x{data[error.start]:02x} at {error.start}; save it as UTF-8",
            code="file/invalid-syntax",
        ) from None


def read_bytes(path: Path) -> bytes:
    """Return the content of a whole regular file.

    Args:
        path: Path of the file. A symbolic link is followed.

    Raises:
        ConfigError: The file is missing, not a regular file, larger than MAX_FILE_BYTES, or not readable.
    """
    try:
        mode = path.stat().st_mode
        data = b""
        if stat.S_ISREG(mode):  # opening a device may have side effects, opening a pipe blocks
            descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            with os.fdopen(descriptor, "rb") as file:
                data = file.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file{_make_missing_file_hint(path)}", code="file/not-found"
        ) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}", code="file/not-readable"
        ) from None
    except ValueError as error:  # a NUL in the name
        raise ConfigError(f"{path}: cannot be read: {error}", code="file/not-readable") from None
    _require_regular_file(path, mode)
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(
            f"{path}: is larger than {MAX_FILE_BYTES // MB} MB, the limit of a settings file",
            code="file/too-large",
        )
    return data


def _make_missing_file_hint(path: Path) -> str:
    """Return the end of the error about a missing file: which existing file the user may have meant."""
    try:
        entries = itertools.islice(path.parent.iterdir(), MAX_SEARCHED_FILES)
        names = sorted(entry.name for entry in entries)
    except OSError as error:
        return f"; its folder {path.parent} cannot be read: {error.strerror}"
    similar = find_nearest_word(path.name, names)
    if similar:
        return f"; did you mean {path.parent / similar}?"
    if not path.suffix:
        return ""
    folder = path.parent.absolute()
    same_suffix = [name for name in names if name.endswith(path.suffix)][:MAX_SUGGESTED_FILES]
    if same_suffix:
        return f"; in {folder} are {', '.join(same_suffix)}"
    return f"; in {folder} is no file *{path.suffix}"


def _require_regular_file(path: Path, mode: int) -> None:
    """Raise ConfigError if a path is a folder, a pipe, a device or a symbolic link."""
    if not stat.S_ISREG(mode):
        file_type = _FILE_TYPE_NAMES.get(stat.S_IFMT(mode), "something else")
        raise ConfigError(
            f"{path}: is {file_type}, not a file; name a file", code="file/not-readable"
        )


def parse_json(text: str, source: str) -> Any:
    """Return the value of a JSON text. Raises ConfigError, which names the source."""
    return _parse(text, source, json.loads, "JSON")


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Return the values of a TOML text. Raises ConfigError, which names the source."""
    if len(text) > MAX_TOML_CHARACTERS:
        raise ConfigError(
            f"{source}: is larger than {MAX_TOML_CHARACTERS // MB} MB; make it smaller, or write it as JSON",
            code="file/too-large",
        )
    deep_key = _TOO_DEEP_KEY_PATTERN.search(text)
    if deep_key:
        raise ConfigError(
            f"{source}: key `{deep_key[0][:40]}...` has more than {MAX_DEPTH} parts",
            code="file/too-large",
        )
    return _parse(text, source, tomllib.loads, "TOML")


def _parse(text: str, source: str, parse: Callable[[str], Any], language: str) -> Any:
    """Parse a text with a parser of its language. Raises ConfigError if it is not valid, or nested too deep."""
    try:
        value = parse(text)
    except RecursionError:
        raise ConfigError(
            f"{source}: not valid {language}: nested deeper than {MAX_DEPTH} levels",
            code="file/too-large",
        ) from None
    except ValueError as error:  # the parser's own; or a number of thousands of digits
        raise ConfigError(
            f"{source}: not valid {language}: {error}", code="file/invalid-syntax"
        ) from None
    _validate_value_depth(value, source)
    return value


def check_nesting_depth(text: str, source: str) -> None:
    """Check the nesting of a text that another library parses: Zenoh overflows its stack on deep nesting.

    Raises:
        ConfigError: The text is nested deeper than MAX_DEPTH.
    """
    depth = 0
    for bracket in re.findall(r"[][{}]", text):
        depth += 1 if bracket in "[{" else -1
        if depth > MAX_DEPTH:
            raise ConfigError(
                f"{source}: is nested deeper than {MAX_DEPTH} levels", code="file/too-large"
            )


def _validate_value_depth(value: Any, source: str) -> None:
    """Raise ConfigError if a value is nested too deep. Later code may then recurse through its levels safely."""
    containers: list[Any] = [value]
    for _ in range(MAX_DEPTH):
        inner: list[Any] = []
        for container in containers:
            if isinstance(container, dict):
                inner += container.values()
            elif isinstance(container, list):
                inner += container
        containers = [part for part in inner if isinstance(part, dict | list)]
        if not containers:
            return
    raise ConfigError(f"{source}: is nested deeper than {MAX_DEPTH} levels", code="file/too-large")


@contextlib.contextmanager
def export_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path for an export. When the `with` block ends, the file or folder there is renamed to `path`.

    If `path` is a symbolic link, the file that it leads to is replaced.

    Args:
        path: Path of the exported file or folder. Missing parent folders are created.

    Yields:
        Path at which the caller writes the file or folder.

    Raises:
        ConfigError: The export cannot be written, for example because the disk is full. What was at `path` before is
            unchanged, and no incomplete file is left.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replace_atomically(Path(os.path.realpath(path))) as partial:
            yield partial
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {_get_error_reason(error)}. What was there before is unchanged. "
            "Make room, or choose another place with --out",
            code="file/not-writable",
        ) from None


def _get_error_reason(error: OSError) -> str:
    """Return why an operation failed. Some libraries raise errors whose number is only in their text."""
    if error.errno is not None:
        return os.strerror(error.errno)
    match = re.search(r"errno (\d+)", str(error))
    if match is not None:
        return os.strerror(int(match[1]))
    return str(error)


def write_text(path: Path, text: str, encoding: str = "utf-8") -> None:
    """Write a file atomically, or leave it unchanged.

    Raises:
        ConfigError: The file cannot be written, or the path is a folder, a symbolic link or a device.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            _require_regular_file(path, path.lstat().st_mode)
        write_atomically(path, text.encode(encoding))
    except OSError as error:
        reason = "its folder is a file" if isinstance(error, FileExistsError) else error.strerror
        raise ConfigError(
            f"{path}: cannot be written: {reason}", code="file/not-writable"
        ) from None
