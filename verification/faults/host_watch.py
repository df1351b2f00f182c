"""Records the statuses that a host sends over its private channel.

The channel is a socket pair, so faults of the network do not affect it. The kernel records when the host sent each
status, so a busy processor does not change the times.
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

SO_TIMESTAMPNS = 35  # of Linux; the module `socket` does not define it
TIMESPEC = struct.Struct("@qq")  # seconds and nanoseconds of the wall clock
POLL_PERIOD_S = 0.0005  # a twentieth of a control period
STATUS_TIMEOUT_S = 10.0  # longer than any reaction to a fault takes
OBSERVER_PRIORITY = 30  # of 99; host and control have 20


@contextlib.contextmanager
def raise_priority() -> Iterator[None]:
    """Give this thread, and the threads that it starts, a higher priority than the robot's processes have.

    A busy controller then does not delay the observer. The threads keep their priority afterwards, but the processes
    that they start do not inherit it. Without the permission to change it, the priority stays as it is.
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
    """Records every status that the host sends over its private channel.

    Attributes:
        inherited: The host's end of the socket pair.
    """

    def __init__(self) -> None:
        self._socket, self.inherited = socket_pair()
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.settimeout(0.1)
        self._statuses: list[ReceivedMessage[RobotStatus]] = []
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="host watch", daemon=True)
        with raise_priority():
            self._thread.start()

    def close(self) -> None:
        """Stop the thread, and close both sockets."""
        self._is_closed.set()
        self._thread.join()
        self._socket.close()
        self.inherited.close()

    def get_lifecycle(self) -> str | None:
        """Return the lifecycle state in the newest status, or None if there was no status yet."""
        if not self._statuses:
            return None
        return self._statuses[-1].message.lifecycle

    def wait_for_status(
        self, condition: Callable[[RobotStatus], bool], since_ns: int, description: str
    ) -> ReceivedMessage[RobotStatus]:
        """Wait for the first status after a time for which a condition holds.

        Args:
            condition: Condition on the status.
            since_ns: Time by the monotonic clock; earlier statuses do not count.
            description: What is awaited, for the error message.

        Raises:
            TrialError: No such status arrived within STATUS_TIMEOUT_S.
        """
        deadline_s = time.monotonic() + STATUS_TIMEOUT_S
        while time.monotonic() < deadline_s:
            for received in list(self._statuses):
                if received.at_ns >= since_ns and condition(received.message):
                    return received
            time.sleep(POLL_PERIOD_S)
        raise TrialError(
            f"no status within {STATUS_TIMEOUT_S:g} s with {description}; newest: "
            f"{self.get_lifecycle()}"
        )

    def measure_extra_delay_ms(self, status: ReceivedMessage[RobotStatus]) -> float:
        """Return how much longer after its tick a status was sent than the fastest of all statuses.

        This is the delay of the tick on a busy computer. It does not depend on what the host decided in the tick.
        """
        delay_ns = status.at_ns - status.message.timestamp_ns
        min_delay_ns = min(other.at_ns - other.message.timestamp_ns for other in self._statuses)
        return (delay_ns - min_delay_ns) / 1e6

    def _listen(self) -> None:
        """Record statuses until this object is closed."""
        decoder = msgspec.msgpack.Decoder(HostMessage)
        while not self._is_closed.is_set():
            try:
                data, ancillary, _, _ = self._socket.recvmsg(
                    MAX_BYTES, socket.CMSG_SPACE(TIMESPEC.size)
                )
                host_message = decoder.decode(data)
            except TimeoutError:
                continue
            except (OSError, msgspec.DecodeError):  # the host has ended
                self._is_closed.wait(0.1)
                continue
            if host_message.status is not None:
                sent_ns = _read_send_time_ns(ancillary)
                self._statuses.append(ReceivedMessage(sent_ns, host_message.status))


def _read_send_time_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """Return when the kernel accepted a message from its sender, by the monotonic clock."""
    wall_minus_monotonic_ns = time.time_ns() - time.monotonic_ns()
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
            seconds, nanoseconds = TIMESPEC.unpack(data)
            return seconds * 1_000_000_000 + nanoseconds - wall_minus_monotonic_ns
    raise TrialError("the kernel did not record when the host sent a status")
