"""An emergency stop stored on disk, so that it outlives the host: the next host finds it and begins in `estop`.

The file is written atomically, and is on the disk before the stop is answered. An unreadable file counts
as latched.

Threads: the host's thread requests, and never waits for a disk. The thread `estop` writes, in the order of the
requests. The thread `estop late` answers a request that the disk has not answered within ANSWER_LIMIT_S: the stop is
not stored yet. So `then` may be called from either of them, but only once.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import msgspec

from snakesim_hal.base.atomic_write import sync_folder, write_atomically
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.workers import start_worker
from snakesim_hal.network.local_registry import state_folder
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Answer

ESTOP = "estop.json"
ANSWER_LIMIT_S = 1.0  # for a disk that hangs; requesters wait longer


class Latched(msgspec.Struct, frozen=True, kw_only=True):
    """Who stopped the robot, and at which tick of that host."""

    requester: str
    tick: int


class EstopLatch:
    """The file of one robot's emergency stop."""

    def __init__(self, folder: Path | None) -> None:
        """Read the stop that an earlier host has left, and start the threads.

        Args:
            folder: of the file; None: no file, the latch lives as long as the host.
        """
        self._path = None if folder is None else folder / ESTOP
        self.left_by_earlier_host = None if self._path is None else _read(self._path)  # left by an earlier host
        self._is_stored = (
            self.left_by_earlier_host is not None and self.left_by_earlier_host.tick >= 0
        )  # False: the file cannot be read
        # Queues of the two threads; None ends them.
        self._requests: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._unanswered: SimpleQueue[_Once | None] = SimpleQueue()
        self._writer = start_worker("estop", self._run_requests)
        start_worker("estop late", self._answer_late)

    def engage(self, requester: str, tick: int, then: Callable[[str | None], None]) -> None:
        """Store a stop.

        Args:
            requester: requester of the stop.
            tick: of this host.
            then: is called once, from another thread: with None, or with the reason why the stop is not stored.
        """
        late = f"it is not stored yet, and may not outlive this host: {self._path}: the disk does not answer"
        once = _Once(then, late)
        self._unanswered.put(once)
        self._requests.put(lambda: self._engage(Latched(requester=requester, tick=tick), once))

    def release(self, then: Callable[[str | None], None]) -> None:
        """Remove the stored stop. `then` is called as in `engage`."""
        once = _Once(then, f"the next host may start in estop: {self._path}: the disk does not answer")
        self._unanswered.put(once)
        self._requests.put(lambda: self._release(once))

    def close(self) -> None:
        """Finish pending requests, unless the disk hangs; then at least answer them."""
        self._requests.put(None)
        self._unanswered.put(None)
        self._writer.join(1.1 * ANSWER_LIMIT_S)

    def _run_requests(self) -> None:
        """Carry out requests, in the writing thread."""
        while (request := self._requests.get()) is not None:
            request()

    def _answer_late(self) -> None:
        """Answer each request when its time is up, if the writing thread has not; in a thread of its own."""
        while (once := self._unanswered.get()) is not None:
            time.sleep(max(once.until_s - time.monotonic(), 0.0))
            once(once.late)

    def _engage(self, latched: Latched, then: Callable[[str | None], None]) -> None:
        if self._path is None or self._is_stored:
            then(None)
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, msgspec.json.encode(latched), durable=True)
            self._is_stored = True
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
            self._is_stored = False
            then(None)
        except OSError as error:
            then(f"the next host will start in estop: {self._path}: {error.strerror}; remove it by hand")


def _read(path: Path) -> Latched | None:
    """Return the stop in a file, or a stop by an unknown requester if the file cannot be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Latched)
    except FileNotFoundError:
        return None
    except (OSError, *UNDECODABLE):
        return Latched(requester=f"unknown ({ESTOP} cannot be read)", tick=-1)


def find_latched_stops() -> list[Path]:
    """Return the file of every emergency stop that is latched on this computer, for this user."""
    return sorted((state_folder() / "robots").glob(f"*/{ESTOP}"))


def remove_latched_stop(path: Path) -> str:
    """Remove the latched stop of a robot whose host does not run, and return a description of it.

    Raises:
        ConfigError: the file cannot be removed.
    """
    latched = _read(path)
    try:
        path.unlink(missing_ok=True)
        sync_folder(path.parent)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; remove it by hand", code="file/not-writable") from error
    return f"emergency stop by {'an unknown client' if latched is None else latched.requester}"


class _Once:
    """Calls `then` at the first call, and ignores later ones. Any thread may call it."""

    def __init__(self, then: Callable[[str | None], None], late: str) -> None:
        """Wrap `then`; late: what to call it with when the time is up."""
        self.late = late
        self.until_s = time.monotonic() + ANSWER_LIMIT_S
        self._then = then
        self._first = threading.Lock()

    def __call__(self, failure: str | None) -> None:
        if self._first.acquire(blocking=False):  # and never released
            self._then(failure)


def make_reply(reply: Callable[[Answer], None], answer: Answer) -> Callable[[str | None], None]:
    """Return a `then` for the latch that sends an answer, together with the reason if the stop is not stored."""

    def on_stored(failure: str | None) -> None:
        if failure is None:
            reply(answer)
        else:
            reply(msgspec.structs.replace(answer, reason=f"{answer.reason}; {failure}"[:500]))

    return on_stored
