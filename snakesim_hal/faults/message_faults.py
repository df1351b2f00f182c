"""Carries out message faults of this process: applies `disturbance` between a publisher and Zenoh.

A publisher without a fault is not touched. A thread sends delayed messages; it exists only while messages are delayed
or a flood is active.

Threads: the part's own thread begins and ends faults, any publishing thread calls `put`, and the worker thread runs
`_send_due_messages`. All of them hold the lock of `_changed` while they use a disturbance.
"""

import threading
import time
from dataclasses import dataclass
from functools import partial
from math import inf

from snakesim_hal.base.workers import start_restarting_thread
from snakesim_hal.faults.disturbance import MessageDisturbance
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.network.session import Session

MIN_PAUSE_S = 0.001  # floods are sent in bursts, so that the thread does not block the interpreter


@dataclass
class DisturbedKey:
    """A key whose outgoing messages have faults."""

    key: str
    disturbance: MessageDisturbance


class MessageFaults:
    """All message faults of one session. Thread-safe."""

    def __init__(self, session: Session, seed: int) -> None:
        """Create an object without faults.

        Args:
            session: Network session whose outgoing messages are disturbed.
            seed: Seed of the run, which decides all random numbers.
        """
        self._session = session
        self._seed = seed
        self._disturbed_by_key: dict[str, DisturbedKey] = {}
        self._changed = threading.Condition()
        # Sends delayed messages; None: nothing is delayed.
        self._delay_thread: threading.Thread | None = None
        self._closed = False

    def begin(self, injection: FaultInjection) -> None:
        """Start a fault of the key that is its target."""
        with self._changed:
            key = injection.target
            disturbed = self._disturbed_by_key.get(key)
            if disturbed is None:
                disturbed = DisturbedKey(key, MessageDisturbance(f"{self._seed} {key}"))
                self._disturbed_by_key[key] = disturbed
                self._session.reroute(key, partial(self.disturb_message, disturbed))
            disturbed.disturbance.start_fault(injection, time.monotonic())
            self._release_or_wake(disturbed)

    def end(self, injection: FaultInjection) -> None:
        """End a fault; pending messages are still sent."""
        with self._changed:
            disturbed = self._disturbed_by_key.get(injection.target)
            if disturbed is not None:
                payloads = disturbed.disturbance.end_fault(injection.kind, time.monotonic())
                self._send(disturbed, payloads)
                self._release_or_wake(disturbed)

    def disturb_message(self, disturbed: DisturbedKey, payload: bytes) -> None:
        """Apply the faults of a key to a message. The publisher calls this instead of `put`, in the writer's thread."""
        with self._changed:
            payloads = disturbed.disturbance.disturb_payload(payload, time.monotonic())
            self._send(disturbed, payloads)
            self._release_or_wake(disturbed)

    def close(self) -> None:
        """Drop delayed messages, and end the thread. Call it before the session is closed."""
        with self._changed:
            self._closed = True
            self._changed.notify()
            worker = self._delay_thread
        if worker is not None:
            worker.join()

    # --- with the lock held ----------------------------------------------------------------------------------

    def _send(self, disturbed: DisturbedKey, payloads: list[bytes]) -> None:
        """Send payloads under a key, past the disturbance."""
        for payload in payloads:
            self._session.send(disturbed.key, payload)

    def _release_or_wake(self, disturbed: DisturbedKey) -> None:
        """Release a key whose faults are over, or else start or wake the thread that sends its delayed messages."""
        if disturbed.disturbance.is_over:
            if self._disturbed_by_key.get(disturbed.key) is disturbed:
                self._session.reroute(disturbed.key, None)
                del self._disturbed_by_key[disturbed.key]
        elif self._find_next_due_time_s() < inf and not self._closed:
            if self._delay_thread is None:
                self._delay_thread = start_restarting_thread(
                    "late messages", self._send_due_messages, should_stop=lambda: self._closed
                )
            self._changed.notify()

    def _find_next_due_time_s(self) -> float:
        """Return the monotonic time of the next delayed message; inf if there is none."""
        return min(
            (disturbed.disturbance.next_due_s() for disturbed in self._disturbed_by_key.values()),
            default=inf,
        )

    # --- the thread ------------------------------------------------------------------------------------------

    def _send_due_messages(self) -> None:
        """Send delayed messages when they are due, until none is left. This runs in the thread for delayed messages."""
        with self._changed:
            while not self._closed:
                next_s = self._find_next_due_time_s()
                if next_s == inf:
                    break
                pause_s = max(next_s - time.monotonic(), MIN_PAUSE_S)
                self._changed.wait(pause_s)
                now_s = time.monotonic()
                for disturbed in list(self._disturbed_by_key.values()):
                    payloads = disturbed.disturbance.pop_due_payloads(now_s)
                    self._send(disturbed, payloads)
                    if disturbed.disturbance.is_over:
                        self._release_or_wake(disturbed)
            self._delay_thread = None
