"""The folder of one run: locked by one process at a time, and never overwriting an earlier run."""

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterator
from datetime import datetime
from itertools import count
from pathlib import Path

from snakesim_hal.base.atomic_write import PARTIAL
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.results.run_reader import CONFIG, REPORT, SUMMARY

LOCK = "run.lock"  # holds the process id of the run that is writing here
OLDER = ("telemetry.jsonl", "blackbox.npz")  # of older versions
LEFT = (CONFIG, HOST_RECORD, BLACK_BOX, RECORDING, SUMMARY, REPORT, *OLDER)
TIME = "%Y%m%d-%H%M%S"


def default_folder(name: str) -> Path:
    """The default folder of a run: runs/NAME-TIME."""
    out = Path("runs") / f"{name}-{datetime.now().strftime(TIME)}"
    return _free(out)


@contextlib.contextmanager
def locked_folder(out: Path, say: Callable[[str], None]) -> Iterator[Path]:
    """Lock a folder for a run, after renaming an earlier run there; the kernel unlocks it after a SIGKILL.

    Raises ConfigError when another run has locked it or it is not usable, OSError when it is not writable.
    """
    out = out.resolve()
    with contextlib.ExitStack() as held:
        held.enter_context(_lock(out))
        if any((out / name).exists() for name in LEFT):
            aside = _move_aside(out)
            say(f"{out} held an earlier run: moved to {aside}")
            held.enter_context(_lock(out))
        try:
            yield out
        finally:
            for partial in out.glob(f"*{PARTIAL}"):  # of a process that was killed while writing
                with contextlib.suppress(OSError):
                    partial.unlink()


@contextlib.contextmanager
def _lock(out: Path) -> Iterator[None]:
    path = out / LOCK
    while True:
        folder = _opened(out)
        try:
            handle = os.open(LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644, dir_fd=folder)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.pread(handle, 20, 0).decode(errors="replace").strip()
                os.close(handle)
                raise ConfigError(
                    f"--out {out}: another run is writing there, process {holder or 'unknown'}; "
                    "choose another folder, or end that run",
                    code="file/in-use",
                ) from None
            if _is(handle, path):
                break
            # The run that had locked it has just ended, or has moved this folder aside: it is an earlier run's now.
            with contextlib.suppress(OSError):
                if os.path.samestat(os.fstat(handle), os.stat(LOCK, dir_fd=folder)):
                    os.unlink(LOCK, dir_fd=folder)
            os.close(handle)
        finally:
            os.close(folder)
    try:
        with contextlib.suppress(OSError):  # a full disk: the lock is valid, but without the process id
            os.ftruncate(handle, 0)
            os.pwrite(handle, str(os.getpid()).encode(), 0)
        yield
    finally:
        with contextlib.suppress(OSError):
            if _is(handle, path):
                path.unlink()
        os.close(handle)


def _opened(out: Path) -> int:
    """The folder, made if it is not there."""
    attempts = 10
    while True:
        attempts -= 1
        try:
            out.mkdir(parents=True, exist_ok=True)
            return os.open(out, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        except (FileExistsError, NotADirectoryError, FileNotFoundError) as error:
            if not attempts or not isinstance(error, FileNotFoundError):  # it may have been moved aside in between
                raise ConfigError(
                    f"--out {out}: {error.strerror}: {error.filename}; choose another folder", code="file/not-writable"
                ) from error


def _is(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def _move_aside(out: Path) -> Path:
    if Path.cwd().is_relative_to(out):
        raise ConfigError(
            f"--out {out} holds an earlier run, and you are in it; choose another folder", code="file/already-exists"
        )
    began_s = min((out / name).stat().st_mtime for name in LEFT if (out / name).exists())
    aside = _free(out.with_name(f"{out.name}.{datetime.fromtimestamp(began_s).strftime(TIME)}"))
    try:
        out.rename(aside)
    except OSError as error:
        raise ConfigError(
            f"--out {out} holds an earlier run that cannot be moved to {aside}: {error.strerror}; "
            "choose another folder",
            code="file/already-exists",
        ) from error
    (aside / LOCK).unlink(missing_ok=True)
    return aside


def _free(path: Path) -> Path:
    """The path, with a number appended if it exists."""
    return next(p for n in count(1) if not (p := path if n == 1 else path.with_name(f"{path.name}-{n}")).exists())
