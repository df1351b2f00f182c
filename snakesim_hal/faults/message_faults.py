"""Carries out message faults of this process: applies `disturbance` between a publisher and Zenoh.

A publisher without a fault is not touched. A thread sends delayed messages; it exists only while messages are delayed
or a flood is active.

Threads: the part's own thread begins and ends faults, any publishing thread calls `put`, and the worker thread runs
`_send_due`. All of them hold the lock of `_changed` while they use a disturbance.
"""

import threading
import time
from dataclasses import dataclass
from functools import partial
from math import inf

from snakesim_hal.base.workers import start_worker
from snakesim_hal.faults.disturbance import Disturbance
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.network.session import Session

MIN_PAUSE_S = 0.001  # floods are sent in bursts, so that the thread does not block the interpreter


@dataclass
class DisturbedKey:
    """A key whose outgoing messages have faults."""

    key: str
    disturbance: Disturbance


class MessageFaults:
    """All message faults of one session. Thread-safe."""

    def __init__(self, session: Session, seed: int) -> None:
        """Disturb messages of a session; seed: of the run."""
        self._session = session
        self._seed = seed
        self._disturbed: dict[str, DisturbedKey] = {}  # by key
        self._changed = threading.Condition()
        self._worker: threading.Thread | None = None  # sends delayed messages; None: nothing is delayed
        self._closed = False

    def begin(self, injection: Injection) -> None:
        """Begin a fault of the key that is its target."""
        with self._changed:
            key = injection.target
            disturbed = self._disturbed.get(key)
            if disturbed is None:
                disturbed = DisturbedKey(key, Disturbance(f"{self._seed} {key}"))
                self._disturbed[key] = disturbed
                self._session.reroute(key, partial(self.disturb_message, disturbed))
            disturbed.disturbance.begin(injection, time.monotonic())
            self._update(disturbed)

    def end(self, injection: Injection) -> None:
        """End a fault; pending messages are still sent."""
        with self._changed:
            disturbed = self._disturbed.get(injection.target)
            if disturbed is not None:
                payloads = disturbed.disturbance.end(injection.kind, time.monotonic())
                self._send(disturbed, payloads)
                self._update(disturbed)

    def disturb_message(self, disturbed: DisturbedKey, payload: bytes) -> None:
        """Disturb a message of the writer, in place of the publisher's own `put`, in the writer's thread."""
        with self._changed:
            payloads = disturbed.disturbance.disturb(payload, time.monotonic())
            self._send(disturbed, payloads)
            self._update(disturbed)

    def close(self) -> None:
        """Drop delayed messages, and end the thread. Call it before the session is closed."""
        with self._changed:
            self._closed = True
            self._changed.notify()
            worker = self._worker
        if worker is not None:
            worker.join()

    # --- with the lock held ----------------------------------------------------------------------------------

    def _send(self, disturbed: DisturbedKey, payloads: list[bytes]) -> None:
        for payload in payloads:
            self._session.send(disturbed.key, payload)

    def _update(self, disturbed: DisturbedKey) -> None:
        """Release a key whose faults are over; start or wake the thread for delayed messages."""
        if disturbed.disturbance.over:
            if self._disturbed.get(disturbed.key) is disturbed:
                self._session.reroute(disturbed.key, None)
                del self._disturbed[disturbed.key]
        elif self._next_s() < inf and not self._closed:
            if self._worker is None:
                self._worker = start_worker("late messages", self._send_due, is_over=lambda: self._closed)
            self._changed.notify()

    def _next_s(self) -> float:
        """Return the monotonic time of the next delayed message; inf if there is none."""
        return min((disturbed.disturbance.next_s() for disturbed in self._disturbed.values()), default=inf)

    # --- the thread ------------------------------------------------------------------------------------------

    def _send_due(self) -> None:
        """Send delayed messages when they are due, in the worker thread, until none is left."""
        with self._changed:
            while not self._closed:
                next_s = self._next_s()
                if next_s == inf:
                    break
                pause_s = max(next_s - time.monotonic(), MIN_PAUSE_S)
                self._changed.wait(pause_s)
                now_s = time.monotonic()
                for disturbed in list(self._disturbed.values()):
                    payloads = disturbed.disturbance.due(now_s)
                    self._send(disturbed, payloads)
                    if disturbed.disturbance.over:
                        self._update(disturbed)
            self._worker = None
