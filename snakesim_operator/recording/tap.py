"""Takes everything that a robot publishes, for a writer that may be slower; never more than MAX_BYTES wait.

In real time what finds no room is dropped, and counted. In lockstep nothing may be lost: there the network waits for
room, and the robot with it, but at most once for LIMIT_S. After that the disk hangs, and the robot goes on without.

In lockstep messages come as fast as the computer is, and those who make them want the processors: so the thread that
receives takes what the kernel holds, rests, and is not woken meanwhile.
"""

import threading
import time
from collections import Counter, deque

from snakesim_hal.network.session import Arrival, Session
from snakesim_hal.wire import keys

MAX_BYTES = 64 * 1024 * 1024
LIMIT_S = 2.0
TAKES_NS, RESTS_S = 1_000_000, 0.005  # in turn; less than the kernel holds on a connection


class Tap:
    """Everything published within one robot's namespace, as it arrives."""

    def __init__(self, session: Session) -> None:
        self.lossless = False
        self.dropped: Counter[str] = Counter()  # by key
        self._waiting: deque[Arrival] = deque()
        self._bytes = 0
        self._rest_at_ns = 0
        self._lock = threading.Lock()
        for row in keys.SPACE:
            if row.kind == "latched":
                session.on_latched_arrival(row.key, self._put)
            elif row.kind == "stream":
                session.on_urgent_arrival(row.key, self._put)  # a thread for each key would wake with every message

    def take(self) -> list[Arrival]:
        """What has arrived since the last call, in order."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            self._bytes = 0
        return taken

    def _put(self, arrival: Arrival) -> None:
        """In Zenoh's threads."""
        if self.lossless and arrival.monotonic_ns > self._rest_at_ns:
            time.sleep(RESTS_S)
            self._rest_at_ns = time.monotonic_ns() + TAKES_NS
        size = len(arrival.payload)
        if self.lossless and self._bytes + size > MAX_BYTES:
            self._wait_for_room(size)
        with self._lock:
            if self._bytes + size > MAX_BYTES:
                self.dropped[arrival.key] += 1
                return
            self._bytes += size
            self._waiting.append(arrival)

    def _wait_for_room(self, size: int) -> None:
        give_up = time.monotonic() + LIMIT_S
        while self._bytes + size > MAX_BYTES:
            if time.monotonic() > give_up:
                self.lossless = False
                return
            time.sleep(0.001)
