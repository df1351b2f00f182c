"""Folder of the last run on this computer, so that `snakesim status` can report a finished run."""

import contextlib
import threading
from pathlib import Path

import msgspec

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.network.local_registry import state_folder
from snakesim_hal.wire.codec import UNDECODABLE

LIMIT_S = 1.0  # for a disk that hangs


class LastRun(msgspec.Struct, frozen=True, kw_only=True):
    """Which run it was, and how it ended."""

    folder: str
    ended: str


def _file() -> Path:
    return state_folder() / "last-run.json"


def remember(folder: str, ended: str) -> None:
    """Note a finished run. Ignores write errors, and waits only briefly."""
    thread = threading.Thread(target=_write, args=(LastRun(folder=folder, ended=ended),), daemon=True)
    thread.start()
    thread.join(LIMIT_S)


def _write(noted: LastRun) -> None:
    with contextlib.suppress(OSError, ValueError):  # the latter: a folder whose name is not text
        _file().parent.mkdir(parents=True, exist_ok=True)
        write_atomically(_file(), msgspec.json.encode(noted))


def recall() -> LastRun | None:
    """The last run; None when there is none."""
    with contextlib.suppress(OSError, *UNDECODABLE):
        return msgspec.json.decode(_file().read_bytes(), type=LastRun)
    return None
