"""Keeps the results of a search in its folder, so that a search that was stopped can be resumed: `search.jsonl`.

The first line has the command, each further one the rewards of a generation. CMA-ES with a seed proposes the same
policies again when it gets the same rewards, so nothing else is needed.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import msgspec

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.base.errors import ConfigError

SEARCH_FILENAME = "search.jsonl"


class SearchCheck(msgspec.Struct, frozen=True):
    """The results of the mean policy with the check seeds: means over the episodes."""

    reward: float
    advance_m: float
    goals: float  # share that reached it


class KeptGeneration(msgspec.Struct, frozen=True):
    """What the simulations of one generation gave."""

    rewards: list[float]  # of each policy, in the order of the search; empty in the last generation
    check: SearchCheck | None  # None: not checked in this generation


class _SearchHeader(msgspec.Struct, frozen=True):
    command: list[str]  # without --out, --workers and --cluster, which change no number
    version: str  # of SnakeSIM


class KeptSearch:
    """The file of one search, open for more generations."""

    def __init__(self, handle: int, generations: list[KeptGeneration]) -> None:
        self._file_descriptor = handle
        self.generations = generations

    def add(self, generation: KeptGeneration) -> None:
        """Append a generation to the file. It is on the disk when this returns."""
        os.write(self._file_descriptor, msgspec.json.encode(generation) + b"\n")
        os.fsync(self._file_descriptor)


@contextmanager
def open_search_file(folder: Path, command: Sequence[str], *, resume: bool) -> Iterator[KeptSearch]:
    """Open the file of a search in a folder.

    Args:
        folder: Folder that the search writes to. It is created if it does not exist.
        command: Command line of the search, without the options that do not change its results.
        resume: If True, continue the search in the folder. If False, start a new search.

    Yields:
        The file with the generations so far, to which new generations can be added.

    Raises:
        ConfigError: The folder holds no search to resume, another search, or, without `resume`, any search.
    """
    path = folder / SEARCH_FILENAME
    header = _SearchHeader(list(command), version("snakesim"))
    if resume:
        generations = _read_generations(path, header)
    elif path.exists():
        raise ConfigError(
            f"--out {folder} holds a search; go on with it by --resume, or choose another folder",
            code="file/already-exists",
        )
    else:
        generations = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(
            path, b"".join(msgspec.json.encode(line) + b"\n" for line in (header, *generations))
        )
        handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
    except OSError as error:
        raise ConfigError(
            f"--out {folder}: {error.strerror}; choose another folder", code="file/not-writable"
        ) from None
    try:
        yield KeptSearch(handle, generations)
    finally:
        os.close(handle)


def _read_generations(path: Path, expected: _SearchHeader) -> list[KeptGeneration]:
    """Read the generations of an earlier search. A last line that is incomplete is left out.

    Args:
        path: Path of the file.
        expected: Header that the file must have, so that it is of the same search.

    Raises:
        ConfigError: The file cannot be read, or is of another search.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"--resume: {path}: {error.strerror}; leave --resume out to begin a search there",
            code="file/not-writable",
        ) from None
    try:
        header_line, *lines = content.split(b"\n")[:-1]
        header = msgspec.json.decode(header_line, type=_SearchHeader)
        generations = [msgspec.json.decode(line, type=KeptGeneration) for line in lines]
    except (ValueError, msgspec.MsgspecError) as error:
        raise ConfigError(
            f"--resume: {path} is no search: {error}; choose another --out",
            code="evaluation/other-search",
        ) from None
    if header != expected:
        raise ConfigError(
            f"--resume: {path} is of another search: {' '.join(header.command)} (SnakeSIM {header.version}); type that "
            "command with --resume, or choose another --out",
            code="evaluation/other-search",
        )
    return generations
