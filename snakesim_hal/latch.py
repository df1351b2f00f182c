"""An emergency stop kept on disk, so that it outlives the host: one that starts and finds it begins in `estop`.

The file is written whole or not at all, and is on the disk before the stop is answered. One that cannot be read counts
as latched. Writing happens beside the host's loop, in the order of the requests: the joints never wait for a disk.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec

from snakesim_hal.messages import Answer

ESTOP = "estop.json"


class Latched(msgspec.Struct, frozen=True, kw_only=True):
    """Who stopped the robot, and at which tick of which host's count."""

    who: str
    tick: int


class EstopLatch:
    """The file of one robot's emergency stop."""

    def __init__(self, folder: Path | None) -> None:
        """folder: where the file is kept; None: nowhere, the latch lives as long as the host."""
        self._path = None if folder is None else folder / ESTOP
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="estop")
        self.found = self._read()  # what an earlier host left
        self._kept = self.found is not None and self.found.tick >= 0

    def engage(self, who: str, tick: int, then: Callable[[str | None], None]) -> None:
        """Keep a stop. `then` is called from another thread: with None, or with why it could not be kept."""
        self._writer.submit(self._engage, Latched(who=who, tick=tick), then)

    def release(self, then: Callable[[str | None], None]) -> None:
        """Forget it. `then` is called as in `engage`."""
        self._writer.submit(self._release, then)

    def close(self) -> None:
        """Finish what was asked for."""
        self._writer.shutdown()

    def _engage(self, latched: Latched, then: Callable[[str | None], None]) -> None:
        if self._path is None or self._kept:
            then(None)
            return
        try:
            _write(self._path, msgspec.json.encode(latched))
            self._kept = True
            then(None)
        except OSError as error:
            then(f"it will not outlive this host: {self._path}: {error.strerror}")

    def _release(self, then: Callable[[str | None], None]) -> None:
        if self._path is None:
            then(None)
            return
        try:
            self._path.unlink(missing_ok=True)
            _sync(self._path.parent)
            self._kept = False
            then(None)
        except OSError as error:
            then(f"the next host will start in estop: {self._path}: {error.strerror}; remove it by hand")

    def _read(self) -> Latched | None:
        if self._path is None:
            return None
        try:
            return msgspec.json.decode(self._path.read_bytes(), type=Latched)
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError):
            return Latched(who=f"somebody ({ESTOP} cannot be read)", tick=-1)


def replying(reply: Callable[[Answer], None], answer: Answer) -> Callable[[str | None], None]:
    """Reply as soon as the latch is written, and say what went wrong with that."""

    def written(trouble: str | None) -> None:
        reply(
            answer if trouble is None else msgspec.structs.replace(answer, reason=f"{answer.reason}; {trouble}"[:500])
        )

    return written


def _write(path: Path, content: bytes) -> None:
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    partial.rename(path)
    _sync(path.parent)


def _sync(folder: Path) -> None:
    """Have the folder's entries on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
