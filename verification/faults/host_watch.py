"""Watches a host over its private channel, from outside of it: no network that fails or is flooded is in between.

The kernel notes when it took over a status from the host, so a busy processor does not delay what is measured here.
"""

import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

import msgspec

from snakesim_hal.network.private_channel import MAX_BYTES, HostMessage, socket_pair
from snakesim_hal.wire.messages import RobotStatus
from verification.faults.observer import ReceivedMessage, TrialError

SO_TIMESTAMPNS = 35  # on Linux; Python has no name for it
TIMESPEC = struct.Struct("@qq")  # seconds and nanoseconds of the wall clock
LOOK_S = 0.0005
LIMIT_S = 10.0
OBSERVER_PRIORITY = 30  # of 99; host and control have 20


@contextlib.contextmanager
def urgently() -> Iterator[None]:
    """Have this thread, and those that start meanwhile, outrank the robot's own where the system lets them.

    So a busy controller does not delay an observer, and has priority. Processes do not inherit it.
    """
    priority = os.sched_param(OBSERVER_PRIORITY)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, priority)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, priority)


class HostWatch:
    """Keeps every status that the host tells its starter."""

    def __init__(self) -> None:
        self._socket, self.inherited = socket_pair()
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.settimeout(0.1)
        self._statuses: list[ReceivedMessage[RobotStatus]] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="host watch", daemon=True)
        with urgently():
            self._thread.start()

    def close(self) -> None:
        """End it."""
        self._over.set()
        self._thread.join()
        self._socket.close()
        self.inherited.close()

    def lifecycle(self) -> str | None:
        """Return the newest status."""
        return self._statuses[-1].message.lifecycle if self._statuses else None

    def first(
        self, condition: Callable[[RobotStatus], bool], since_ns: int, what: str
    ) -> ReceivedMessage[RobotStatus]:
        """The first status after a time of which a condition holds. Raises TrialError when none comes."""
        deadline = time.monotonic() + LIMIT_S
        while time.monotonic() < deadline:
            for received in list(self._statuses):
                if received.at_ns >= since_ns and condition(received.message):
                    return received
            time.sleep(LOOK_S)
        raise TrialError(
            f"the host did not say within {LIMIT_S:g} s: {what}; last: {self.lifecycle()}"
        )

    def late_ms(self, status: ReceivedMessage[RobotStatus]) -> float:
        """Return how much later the host sent a status, after the begin of its tick by the clock, than at its fastest.

        This is the delay of one tick on a busy computer. It does not depend on what the host decided in the tick.
        """
        fastest_ns = min(other.at_ns - other.message.timestamp_ns for other in self._statuses)
        return (status.at_ns - status.message.timestamp_ns - fastest_ns) / 1e6

    def _listen(self) -> None:
        decoder = msgspec.msgpack.Decoder(HostMessage)
        while not self._over.is_set():
            try:
                data, ancillary, _, _ = self._socket.recvmsg(
                    MAX_BYTES, socket.CMSG_SPACE(TIMESPEC.size)
                )
                host_message = decoder.decode(data)
            except TimeoutError:
                continue
            except (OSError, msgspec.DecodeError):  # the host is gone
                self._over.wait(0.1)
                continue
            if host_message.status is not None:
                sent_ns = _sent_at_ns(ancillary)
                self._statuses.append(ReceivedMessage(sent_ns, host_message.status))


def _sent_at_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """Return when the kernel took over a message, by the monotonic clock."""
    wall_minus_monotonic_ns = time.time_ns() - time.monotonic_ns()
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
            seconds, nanoseconds = TIMESPEC.unpack(data)
            return seconds * 1_000_000_000 + nanoseconds - wall_minus_monotonic_ns
    raise TrialError("the kernel did not note when it took over a status of the host")
