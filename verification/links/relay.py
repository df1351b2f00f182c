"""A link between two network namespaces that delays and drops Ethernet frames, for kernels without `netem`.

    python -m verification.links.relay PID_A PID_B NAME

The process creates an interface NAME in the network namespaces of two processes, and forwards frames between them. It
prints `ready` when both interfaces exist. A line of JSON on standard input changes the quality of the link:

    {"loss": 0.01, "delay_s": 0.02, "jitter_s": 0.01, "cut": false}

Loss, delay and jitter (uniformly distributed) apply to each direction. A property that a line does not name becomes
perfect. Frames keep their order, as in a queue. The process ends when its standard input is closed.
"""

import ctypes
import fcntl
import json
import os
import random
import select
import struct
import sys
import time
from collections import deque
from dataclasses import dataclass

from snakesim_hal.base.process import HOST_PRIORITY, set_realtime_priority

# Numbers of the Linux kernel, from <linux/if_tun.h> and <linux/sched.h>.
TUNSETIFF = 0x400454CA
IFF_TAP = 0x0002
IFF_NO_PI = 0x1000
CLONE_NEWNET = 0x40000000

STDIN = 0  # file descriptor
MAX_READ_BYTES = 65536
IDLE_WAIT_S = 1.0


@dataclass
class LinkQuality:
    """The quality of each direction of the link."""

    loss: float = 0.0  # probability that a frame is dropped
    delay_s: float = 0.0
    jitter_s: float = 0.0  # the delay differs by up to this much
    cut: bool = False  # drops every frame


class RelayDirection:
    """Frames on their way from one interface to the other."""

    def __init__(self, source: int, sink: int) -> None:
        """Forward frames between two open TAP interfaces, given by their file descriptors."""
        self.source = source
        self.sink = sink
        self._queue: deque[tuple[float, bytes]] = deque()  # (time to send in s, frame)

    def read_frames(self, now_s: float, quality: LinkQuality) -> None:
        """Read all frames that have arrived, and drop or queue each of them."""
        while True:
            try:
                frame = os.read(self.source, MAX_READ_BYTES)
            except OSError:  # no frame is left, or the interface is down
                return
            if quality.cut or random.random() < quality.loss:
                continue
            send_time_s = now_s + quality.delay_s + random.uniform(-1, 1) * quality.jitter_s
            if self._queue:
                last_send_time_s, _ = self._queue[-1]
                send_time_s = max(send_time_s, last_send_time_s)
            self._queue.append((send_time_s, frame))

    def send_due_frames(self, now_s: float) -> float:
        """Send the frames whose delay is over, and return the time until the next one is due, in s."""
        while self._queue and self._queue[0][0] <= now_s:
            _, frame = self._queue.popleft()
            try:
                os.write(self.sink, frame)
            except OSError:  # the interface is down: the frame is lost, as on a real link
                continue
        if not self._queue:
            return IDLE_WAIT_S
        next_send_time_s, _ = self._queue[0]
        return next_send_time_s - now_s


def open_tap(pid: str, name: str) -> int:
    """Create a TAP interface in the network namespace of a process, and return its file descriptor.

    This process stays in that namespace.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    namespace = os.open(f"/proc/{pid}/ns/net", os.O_RDONLY)
    if libc.setns(namespace, CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "setns")
    os.close(namespace)
    tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TAP | IFF_NO_PI))
    return tap


def main() -> None:
    """Forward frames until standard input is closed."""
    pid_a, pid_b, name = sys.argv[1:]
    tap_a = open_tap(pid_a, name)
    tap_b = open_tap(pid_b, name)
    set_realtime_priority(HOST_PRIORITY + 1)
    directions = [RelayDirection(tap_a, tap_b), RelayDirection(tap_b, tap_a)]
    quality = LinkQuality()
    os.set_blocking(STDIN, False)
    print("ready", flush=True)
    wait_s = IDLE_WAIT_S
    while True:
        readable, _, _ = select.select([STDIN, tap_a, tap_b], [], [], max(wait_s, 0.0))
        if STDIN in readable:
            orders = os.read(STDIN, MAX_READ_BYTES)
            if not orders:
                return
            for order in orders.splitlines():
                quality = LinkQuality(**json.loads(order))
        for direction in directions:
            if direction.source in readable:
                direction.read_frames(time.monotonic(), quality)
        wait_s = min(direction.send_due_frames(time.monotonic()) for direction in directions)


if __name__ == "__main__":
    main()
