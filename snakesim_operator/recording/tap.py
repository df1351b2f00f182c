"""Collects everything that a robot publishes, for a writer that may be slower; at most MAX_QUEUED_BYTES wait.

In real time, a message that finds no room is dropped and counted. In lockstep no message may be lost: there the
network waits for room, and the robot with it, but once for at most DISK_TIMEOUT_S. After that the disk is taken to
hang, and the robot continues without the recording.

In lockstep messages come as fast as the computer is, and the processes that make them need the processors. So the
receiving thread reads what the kernel holds, rests, and is not woken meanwhile. On a busy computer, a rest may last
much longer than requested; then the thread also reads for longer, so that it keeps its share.
"""

import threading
import time
from collections import Counter, deque

from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys

MAX_QUEUED_BYTES = 64 * 1024 * 1024
DISK_TIMEOUT_S = 2.0  # for a disk to take messages, in lockstep
REST_DURATION_S = 0.005  # less than the kernel can hold on a connection
RECEIVE_SHARE = 0.2  # in lockstep: the time in which messages are received, of the rest before
ROOM_POLL_S = 0.001


class MessageTap:
    """Queues every message below one robot's namespace, in Zenoh's threads, until the recorder takes them."""

    def __init__(self, session: Session) -> None:
        """Subscribe to every key of a robot. Messages are queued until the recorder takes them; memory is bounded.

        Args:
            session: Session on the robot's network.
        """
        self.is_lossless = False  # whether the network waits for room; set in lockstep
        self.dropped_count_by_key: Counter[str] = Counter()  # by key
        self._queue: deque[ReceivedSample] = deque()
        self._queued_bytes = 0
        self._next_rest_ns = 0
        self._lock = threading.Lock()
        for row in keys.SPACE:
            if row.kind == "latched":
                session.on_latched_arrival(row.key, self._queue_or_drop)
            elif row.kind == "stream":
                # Urgent: otherwise each key had a thread, which would wake with every message.
                session.on_urgent_arrival(row.key, self._queue_or_drop)

    def take_arrivals(self) -> list[ReceivedSample]:
        """Return the messages that have arrived since the last call, in order, and remove them from the queue."""
        with self._lock:
            arrivals = list(self._queue)
            self._queue.clear()
            self._queued_bytes = 0
        return arrivals

    def _queue_or_drop(self, arrival: ReceivedSample) -> None:
        """Queue a message, or drop and count it if the queue is full. This runs in Zenoh's threads."""
        if self.is_lossless and arrival.monotonic_ns > self._next_rest_ns:
            self._rest()
        size = len(arrival.payload)
        if self.is_lossless and self._queued_bytes + size > MAX_QUEUED_BYTES:
            self._wait_for_room(size)
        with self._lock:
            if self._queued_bytes + size > MAX_QUEUED_BYTES:
                self.dropped_count_by_key[arrival.key] += 1
                return
            self._queued_bytes += size
            self._queue.append(arrival)

    def _rest(self) -> None:
        """Rest, and plan the next rest. The time until then is in proportion to how long this rest really lasted."""
        start_ns = time.monotonic_ns()
        time.sleep(REST_DURATION_S)
        end_ns = time.monotonic_ns()
        self._next_rest_ns = end_ns + round(RECEIVE_SHARE * (end_ns - start_ns))

    def _wait_for_room(self, size: int) -> None:
        """Wait until a message of this size finds room; after DISK_TIMEOUT_S, never wait again."""
        deadline_s = time.monotonic() + DISK_TIMEOUT_S
        while self._queued_bytes + size > MAX_QUEUED_BYTES:
            if time.monotonic() > deadline_s:
                self.is_lossless = False
                return
            time.sleep(ROOM_POLL_S)
