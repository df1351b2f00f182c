"""The folder of one run: locked by one process at a time, and never overwriting an earlier run."""

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

from snakesim_hal.base.atomic_write import PARTIAL_SUFFIX
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.results.run_reader import CONFIG_FILENAME, REPORT_FILENAME, SUMMARY_FILENAME

LOCK = "run.lock"  # holds the process id of the run that is writing here
FILES_OF_OLDER_VERSIONS = ("telemetry.jsonl", "blackbox.npz")
RUN_FILES = (
    CONFIG_FILENAME,
    HOST_RECORD,
    BLACK_BOX,
    RECORDING_FILENAME,
    SUMMARY_FILENAME,
    REPORT_FILENAME,
    *FILES_OF_OLDER_VERSIONS,
)
TIME_FORMAT = "%Y%m%d-%H%M%S"
MAX_OPEN_ATTEMPTS = 10  # attempts for a folder that other processes rename meanwhile


def choose_default_folder(name: str) -> Path:
    """Return the default folder of a run, runs/NAME-TIME, which does not exist yet."""
    out = Path("runs") / f"{name}-{datetime.now().strftime(TIME_FORMAT)}"
    return _find_free_path(out)


@contextlib.contextmanager
def lock_run_folder(out: Path, report: Callable[[str], None]) -> Iterator[Path]:
    """Lock a folder for a run while the context is active. The kernel unlocks it after a SIGKILL.

    A folder with an earlier run is renamed first, and created again.

    Args:
        out: Path of the folder; created if it does not exist.
        report: Called with a sentence if an earlier run was renamed.

    Yields:
        The absolute path of the folder.

    Raises:
        ConfigError: Another run has locked the folder, or it is not usable.
        OSError: The folder is not writable.
    """
    out = out.resolve()
    with contextlib.ExitStack() as locks:
        locks.enter_context(_hold_lock_file(out))
        if any((out / name).exists() for name in RUN_FILES):
            renamed = _rename_earlier_run(out)
            report(f"{out} held an earlier run: moved to {renamed}")
            locks.enter_context(_hold_lock_file(out))
        try:
            yield out
        finally:
            _remove_partial_files(out)


def _remove_partial_files(out: Path) -> None:
    """Remove the partial files of processes that were killed while writing."""
    for partial in out.glob(f"*{PARTIAL_SUFFIX}"):
        with contextlib.suppress(OSError):
            partial.unlink()


@contextlib.contextmanager
def _hold_lock_file(out: Path) -> Iterator[None]:
    """Hold the lock file of a folder while the context is active. Raises ConfigError if another run holds it."""
    path = out / LOCK
    lock_handle = None
    while lock_handle is None:
        lock_handle = _try_to_lock(out)
    try:
        with contextlib.suppress(
            OSError
        ):  # a full disk: the lock is valid, but without the process id
            os.ftruncate(lock_handle, 0)
            os.pwrite(lock_handle, str(os.getpid()).encode(), 0)
        yield
    finally:
        with contextlib.suppress(OSError):
            if _is_same_file(lock_handle, path):
                path.unlink()
        os.close(lock_handle)


def _try_to_lock(out: Path) -> int | None:
    """Try once to lock the lock file of a folder.

    Returns:
        The handle of the locked file, or None if the caller has to try again: the file at that path is no longer the
        locked file, because the run that had locked it has just ended, or because the folder was renamed.

    Raises:
        ConfigError: Another run has locked the folder.
    """
    folder_handle = _open_folder(out)
    try:
        lock_handle = os.open(
            LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644, dir_fd=folder_handle
        )
        try:
            fcntl.flock(lock_handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(lock_handle, 20, 0).decode(errors="replace").strip()
            os.close(lock_handle)
            raise ConfigError(
                f"--out {out}: another run is writing there, process {holder or 'unknown'}; "
                "choose another folder, or end that run",
                code="file/in-use",
            ) from None
        if _is_same_file(lock_handle, out / LOCK):
            return lock_handle
        with contextlib.suppress(OSError):
            # In a renamed folder the lock file may still be there: that folder holds an earlier run now.
            if os.path.samestat(os.fstat(lock_handle), os.stat(LOCK, dir_fd=folder_handle)):
                os.unlink(LOCK, dir_fd=folder_handle)
        os.close(lock_handle)
        return None
    finally:
        os.close(folder_handle)


def _open_folder(out: Path) -> int:
    """Create a folder if it does not exist, and return a handle of it. Raises ConfigError if that fails."""
    attempts_left = MAX_OPEN_ATTEMPTS
    while True:
        attempts_left -= 1
        try:
            out.mkdir(parents=True, exist_ok=True)
            return os.open(out, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        except (FileExistsError, NotADirectoryError, FileNotFoundError) as error:
            was_just_renamed = isinstance(error, FileNotFoundError)
            if not attempts_left or not was_just_renamed:
                raise ConfigError(
                    f"--out {out}: {error.strerror}: {error.filename}; choose another folder",
                    code="file/not-writable",
                ) from error


def _is_same_file(handle: int, path: Path) -> bool:
    """Return whether the open file is the one at the path."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def _rename_earlier_run(out: Path) -> Path:
    """Rename a folder to FOLDER.TIME, with the time of its earlier run, and return the new path. Raises ConfigError."""
    if Path.cwd().is_relative_to(out):
        raise ConfigError(
            f"--out {out} holds an earlier run, and you are in it; choose another folder",
            code="file/already-exists",
        )
    start_s = min((out / name).stat().st_mtime for name in RUN_FILES if (out / name).exists())
    start_time = datetime.fromtimestamp(start_s).strftime(TIME_FORMAT)
    renamed = _find_free_path(out.with_name(f"{out.name}.{start_time}"))
    try:
        out.rename(renamed)
    except OSError as error:
        raise ConfigError(
            f"--out {out} holds an earlier run that cannot be moved to {renamed}: {error.strerror}; "
            "choose another folder",
            code="file/already-exists",
        ) from error
    (renamed / LOCK).unlink(missing_ok=True)
    return renamed


def _find_free_path(path: Path) -> Path:
    """Return the path, with a number appended if the path exists."""
    free_path = path
    number = 1
    while free_path.exists():
        number += 1
        free_path = path.with_name(f"{path.name}-{number}")
    return free_path
