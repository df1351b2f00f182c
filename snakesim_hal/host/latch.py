"""An emergency stop stored on disk, so that it outlives the host: the next host finds it and begins in `estop`.

The file is written atomically, and is on the disk before the stop is answered. An unreadable file counts
as latched.

Threads: the host's thread requests, and never waits for a disk. The thread `estop` writes, in the order of the
requests. The thread `estop late` answers a request that the disk has not answered within ANSWER_LIMIT_S: the stop is
not stored yet. So `on_finished` may be called from either of them, but only once.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import msgspec

from snakesim_hal.base.atomic_write import sync_folder, write_atomically
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.workers import start_restarting_thread
from snakesim_hal.network.local_registry import get_state_folder
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Answer

ESTOP = "estop.json"
ANSWER_LIMIT_S = 1.0  # for a disk that hangs; requesters wait longer


class LatchedStop(msgspec.Struct, frozen=True, kw_only=True):
    """Who stopped the robot, and at which tick of that host."""

    requester: str
    tick: int


class EstopLatch:
    """The file of one robot's emergency stop."""

    def __init__(self, folder: Path | None) -> None:
        """Read the stop that an earlier host has left, and start the threads.

        Args:
            folder: Folder of the file. None for a latch without a file, which ends with the host.
        """
        self._path = None if folder is None else folder / ESTOP
        # Left by an earlier host.
        self.left_by_earlier_host = None if self._path is None else _read(self._path)
        # False: the file cannot be read.
        self._is_stored = (
            self.left_by_earlier_host is not None and self.left_by_earlier_host.tick >= 0
        )
        # Queues of the two threads; None ends them.
        self._requests: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._unanswered: SimpleQueue[_OneTimeCallback | None] = SimpleQueue()
        self._writer = start_restarting_thread("estop", self._execute_requests)
        start_restarting_thread("estop late", self._answer_overdue_requests)

    def engage(self, requester: str, tick: int, on_finished: Callable[[str | None], None]) -> None:
        """Store a stop on the disk, in another thread.

        Args:
            requester: Name of the requester of the stop.
            tick: Tick of this host at which the stop was requested.
            on_finished: Function that another thread calls once: with None, or with the reason why the stop is
                not stored.
        """
        late = f"it is not stored yet, and may not outlive this host: {self._path}: the disk does not answer"
        once = _OneTimeCallback(on_finished, late)
        self._unanswered.put(once)
        self._requests.put(
            lambda: self._store_stop(LatchedStop(requester=requester, tick=tick), once)
        )

    def release(self, on_finished: Callable[[str | None], None]) -> None:
        """Remove the stored stop in another thread. The callback is called as in `engage`."""
        once = _OneTimeCallback(
            on_finished, f"the next host may start in estop: {self._path}: the disk does not answer"
        )
        self._unanswered.put(once)
        self._requests.put(lambda: self._remove_stop(once))

    def close(self) -> None:
        """Finish pending requests, unless the disk hangs. In that case answer them anyway."""
        self._requests.put(None)
        self._unanswered.put(None)
        self._writer.join(1.1 * ANSWER_LIMIT_S)

    def _execute_requests(self) -> None:
        """Carry out requests, in the writing thread."""
        while (request := self._requests.get()) is not None:
            request()

    def _answer_overdue_requests(self) -> None:
        """Answer each request when its time is up, if the writing thread has not; in a thread of its own."""
        while (once := self._unanswered.get()) is not None:
            time.sleep(max(once.until_s - time.monotonic(), 0.0))
            once(once.late)

    def _store_stop(self, latched: LatchedStop, on_finished: Callable[[str | None], None]) -> None:
        if self._path is None or self._is_stored:
            on_finished(None)
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, msgspec.json.encode(latched), durable=True)
            self._is_stored = True
            on_finished(None)
        except OSError as error:
            on_finished(f"it will not outlive this host: {self._path}: {error.strerror}")

    def _remove_stop(self, on_finished: Callable[[str | None], None]) -> None:
        if self._path is None:
            on_finished(None)
            return
        try:
            if self._path.parent.exists():  # else no stop was ever latched for this robot
                self._path.unlink(missing_ok=True)
                sync_folder(self._path.parent)
            self._is_stored = False
            on_finished(None)
        except OSError as error:
            on_finished(
                f"the next host will start in estop: {self._path}: {error.strerror}; remove it by hand"
            )


def _read(path: Path) -> LatchedStop | None:
    """Return the stop in a file, or a stop by an unknown requester if the file cannot be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=LatchedStop)
    except FileNotFoundError:
        return None
    except (OSError, *UNDECODABLE):
        return LatchedStop(requester=f"unknown ({ESTOP} cannot be read)", tick=-1)


def find_latched_stops() -> list[Path]:
    """Return the file of every emergency stop that is latched on this computer, for this user."""
    return sorted((get_state_folder() / "robots").glob(f"*/{ESTOP}"))


def remove_latched_stop(path: Path) -> str:
    """Remove the latched stop of a robot whose host does not run, and return a description of it.

    Raises:
        ConfigError: The file cannot be removed.
    """
    latched = _read(path)
    try:
        path.unlink(missing_ok=True)
        sync_folder(path.parent)
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; remove it by hand", code="file/not-writable"
        ) from error
    return f"emergency stop by {'an unknown client' if latched is None else latched.requester}"


class _OneTimeCallback:
    """Calls `on_finished` at the first call, and ignores later ones. Any thread may call it."""

    def __init__(self, on_finished: Callable[[str | None], None], late: str) -> None:
        """Wrap a callback.

        Args:
            on_finished: Function to call at most once.
            late: Text to call it with when the time is up.
        """
        self.late = late
        self.until_s = time.monotonic() + ANSWER_LIMIT_S
        self._callback = on_finished
        self._first = threading.Lock()

    def __call__(self, failure: str | None) -> None:
        if self._first.acquire(blocking=False):  # and never released
            self._callback(failure)


def make_storage_callback(
    reply: Callable[[Answer], None], answer: Answer
) -> Callable[[str | None], None]:
    """Return an `on_finished` callback that sends an answer, with the reason if the stop is not stored."""

    def on_stored(failure: str | None) -> None:
        if failure is None:
            reply(answer)
        else:
            reply(msgspec.structs.replace(answer, reason=f"{answer.reason}; {failure}"[:500]))

    return on_stored
