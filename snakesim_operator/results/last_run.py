"""Stores the folder of the user's last run, so that `snakesim status` can report a finished run."""

import contextlib
import threading
from pathlib import Path

import msgspec

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.network.local_registry import state_folder
from snakesim_hal.wire.codec import UNDECODABLE

MAX_WRITE_S = 1.0  # a hanging disk must not keep the run from ending


class LastRun(msgspec.Struct, frozen=True, kw_only=True):
    """The last run of this user on this computer."""

    folder: str
    ended: str  # "complete", or a sentence


def save_last_run(folder: str, ended: str) -> None:
    """Store which run has finished. Ignores write errors, and waits at most MAX_WRITE_S for the disk."""
    last_run = LastRun(folder=folder, ended=ended)
    thread = threading.Thread(target=_write, args=(last_run,), daemon=True)
    thread.start()
    thread.join(MAX_WRITE_S)


def read_last_run() -> LastRun | None:
    """Return the last run, or None if none is stored."""
    with contextlib.suppress(OSError, *UNDECODABLE):
        return msgspec.json.decode(_find_file().read_bytes(), type=LastRun)
    return None


def _find_file() -> Path:
    return state_folder() / "last-run.json"


def _write(last_run: LastRun) -> None:
    with contextlib.suppress(OSError, ValueError):  # ValueError: the folder's name is no text
        file = _find_file()
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, msgspec.json.encode(last_run))
