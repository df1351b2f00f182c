"""Message faults of this process: applies `disturbance` between a publisher and Zenoh.

A publisher without a fault is not touched. A thread sends delayed messages; it exists only while messages are delayed
or a flood is active.
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

SHORTEST_PAUSE_S = 0.001  # floods are sent in bursts, so that the thread does not block the interpreter


@dataclass
class Line:
    """The outgoing messages of one key."""

    key: str
    disturbance: Disturbance


class MessageFaults:
    """All message faults of one session. Thread-safe."""

    def __init__(self, session: Session, seed: int) -> None:
        self._session, self._seed = session, seed
        self._lines: dict[str, Line] = {}
        self._changed = threading.Condition()
        self._later: threading.Thread | None = None
        self._closed = False

    def begin(self, injection: Injection) -> None:
        """Begin a fault."""
        with self._changed:
            key = injection.target
            line = self._lines.get(key)
            if line is None:
                line = self._lines[key] = Line(key, Disturbance(f"{self._seed} {key}"))
                self._session.reroute(key, partial(self.put, line))
            line.disturbance.begin(injection, time.monotonic())
            self._see_to(line)

    def end(self, injection: Injection) -> None:
        """End a fault; pending messages are still sent."""
        with self._changed:
            line = self._lines.get(injection.target)
            if line is not None:
                self._send(line, line.disturbance.end(injection.kind, time.monotonic()))
                self._see_to(line)

    def put(self, line: Line, payload: bytes) -> None:
        """Take a message of the writer, in place of the publisher's own `put`."""
        with self._changed:
            self._send(line, line.disturbance.put(payload, time.monotonic()))
            self._see_to(line)

    def close(self) -> None:
        """Drop delayed messages. Call it before the session is closed."""
        with self._changed:
            self._closed = True
            self._changed.notify()
            later = self._later
        if later is not None:
            later.join()

    # --- with the lock held ----------------------------------------------------------------------------------

    def _send(self, line: Line, payloads: list[bytes]) -> None:
        for payload in payloads:
            self._session.send(line.key, payload)

    def _see_to(self, line: Line) -> None:
        """Release a line without faults; start the thread for delayed messages."""
        if line.disturbance.over:
            if self._lines.get(line.key) is line:
                self._session.reroute(line.key, None)
                del self._lines[line.key]
        elif self._next_s() < inf and not self._closed:
            if self._later is None:
                self._later = start_worker("late messages", self._send_later, is_over=lambda: self._closed)
            self._changed.notify()

    def _next_s(self) -> float:
        return min((line.disturbance.next_s() for line in self._lines.values()), default=inf)

    # --- the thread ------------------------------------------------------------------------------------------

    def _send_later(self) -> None:
        with self._changed:
            while not self._closed and (next_s := self._next_s()) < inf:
                pause_s = max(next_s - time.monotonic(), SHORTEST_PAUSE_S)
                self._changed.wait(pause_s)
                now_s = time.monotonic()
                for line in list(self._lines.values()):
                    self._send(line, line.disturbance.due(now_s))
                    if line.disturbance.over:
                        self._see_to(line)
            self._later = None
