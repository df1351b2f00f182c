"""An emergency stop stored on disk, so that it outlives the host: the next host finds it and begins in `estop`.

The file is written atomically, and is on the disk before the stop is answered. An unreadable file counts
as latched. A separate thread writes, in the order of the requests: the joints never wait for a disk, and
an answer waits no longer than ANSWER_LIMIT_S; then it says that the stop is not stored yet.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import msgspec

from snakesim_hal.base.atomic_write import sync_folder, write_whole
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.workers import start_worker
from snakesim_hal.network.local_registry import state_folder
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Answer

ESTOP = "estop.json"
ANSWER_LIMIT_S = 1.0  # for a disk that hangs; requesters wait longer


class Latched(msgspec.Struct, frozen=True, kw_only=True):
    """Who stopped the robot, and at which tick of that host."""

    who: str
    tick: int


class EstopLatch:
    """The file of one robot's emergency stop."""

    def __init__(self, folder: Path | None) -> None:
        """folder: of the file; None: no file, the latch lives as long as the host."""
        self._path = None if folder is None else folder / ESTOP
        self._asked: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._waiting: SimpleQueue[_Once | None] = SimpleQueue()
        self.found = None if self._path is None else _read(self._path)  # left by an earlier host
        self._kept = self.found is not None and self.found.tick >= 0
        self._writer = start_worker("estop", self._write)
        start_worker("estop late", self._give_up)

    def engage(self, who: str, tick: int, then: Callable[[str | None], None]) -> None:
        """Store a stop. `then` is called once, from another thread: with None, or with why it could not be stored."""
        late = f"it is not stored yet, and may not outlive this host: {self._path}: the disk does not answer"
        once = _Once(then, late)
        self._waiting.put(once)
        self._asked.put(lambda: self._engage(Latched(who=who, tick=tick), once))

    def release(self, then: Callable[[str | None], None]) -> None:
        """Remove it. `then` is called as in `engage`."""
        once = _Once(then, f"the next host may start in estop: {self._path}: the disk does not answer")
        self._waiting.put(once)
        self._asked.put(lambda: self._release(once))

    def close(self) -> None:
        """Finish pending requests, unless the disk hangs; then at least answer them."""
        self._asked.put(None)
        self._waiting.put(None)
        self._writer.join(1.1 * ANSWER_LIMIT_S)

    def _write(self) -> None:
        while (ask := self._asked.get()) is not None:
            ask()

    def _give_up(self) -> None:
        while (once := self._waiting.get()) is not None:
            time.sleep(max(once.until_s - time.monotonic(), 0.0))
            once(once.late)

    def _engage(self, latched: Latched, then: Callable[[str | None], None]) -> None:
        if self._path is None or self._kept:
            then(None)
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._path, msgspec.json.encode(latched), durable=True)
            self._kept = True
            then(None)
        except OSError as error:
            then(f"it will not outlive this host: {self._path}: {error.strerror}")

    def _release(self, then: Callable[[str | None], None]) -> None:
        if self._path is None:
            then(None)
            return
        try:
            if self._path.parent.exists():  # else no stop was ever latched for this robot
                self._path.unlink(missing_ok=True)
                sync_folder(self._path.parent)
            self._kept = False
            then(None)
        except OSError as error:
            then(f"the next host will start in estop: {self._path}: {error.strerror}; remove it by hand")


def _read(path: Path) -> Latched | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Latched)
    except FileNotFoundError:
        return None
    except (OSError, *UNDECODABLE):
        return Latched(who=f"unknown ({ESTOP} cannot be read)", tick=-1)


def stops_kept() -> list[Path]:
    """The file of every emergency stop that is latched on this computer, for this user."""
    return sorted((state_folder() / "robots").glob(f"*/{ESTOP}"))


def forget_stop(path: Path) -> str:
    """Remove a latched stop, for a robot whose host does not run; returns a description of it. Raises ConfigError."""
    found = _read(path)
    try:
        path.unlink(missing_ok=True)
        sync_folder(path.parent)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; remove it by hand") from error
    return f"emergency stop by {'nobody' if found is None else found.who}"


class _Once:
    """Calls `then` once, with its first argument."""

    def __init__(self, then: Callable[[str | None], None], late: str) -> None:
        self.late = late
        self.until_s = time.monotonic() + ANSWER_LIMIT_S
        self._then = then
        self._first = threading.Lock()

    def __call__(self, failure: str | None) -> None:
        if self._first.acquire(blocking=False):  # and never released
            self._then(failure)


def replying(reply: Callable[[Answer], None], answer: Answer) -> Callable[[str | None], None]:
    """Reply as soon as the latch is written, and report errors of that."""

    def written(failure: str | None) -> None:
        reply(
            answer if failure is None else msgspec.structs.replace(answer, reason=f"{answer.reason}; {failure}"[:500])
        )

    return written
