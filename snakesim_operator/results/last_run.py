"""Stores the folder of the user's last run, so that `snakesim status` can report a finished run."""

import contextlib
import threading
from pathlib import Path

import msgspec

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.network.local_registry import get_state_folder
from snakesim_hal.wire.codec import UNDECODABLE

WRITE_TIMEOUT_S = 1.0  # a hanging disk must not keep the run from ending


class LastRun(msgspec.Struct, frozen=True, kw_only=True):
    """The last run of this user on this computer."""

    folder: str
    ended: str  # "complete", or a sentence


def save_last_run(folder: str, ended: str) -> None:
    """Store which run has finished. Write errors are ignored, and the disk is awaited for WRITE_TIMEOUT_S at most.

    Args:
        folder: Path of the run folder.
        ended: "complete", or a sentence on how the run ended.
    """
    last_run = LastRun(folder=folder, ended=ended)
    thread = threading.Thread(target=_write_last_run, args=(last_run,), daemon=True)
    thread.start()
    thread.join(WRITE_TIMEOUT_S)


def read_last_run() -> LastRun | None:
    """Return the last run, or None if none is stored."""
    with contextlib.suppress(OSError, *UNDECODABLE):
        return msgspec.json.decode(_get_last_run_path().read_bytes(), type=LastRun)
    return None


def _get_last_run_path() -> Path:
    return get_state_folder() / "last-run.json"


def _write_last_run(last_run: LastRun) -> None:
    with contextlib.suppress(
        OSError, ValueError
    ):  # ValueError: the name of the folder is not valid text
        file = _get_last_run_path()
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, msgspec.json.encode(last_run))
