"""A link between two network namespaces that loses and delays Ethernet frames: for kernels that have no `netem`.

    python -m verification.links.relay PID_A PID_B NAME

makes an interface NAME in the network namespaces of two processes, and carries frames between them. A line of JSON on
stdin changes it: {"loss": 0.01, "delay_s": 0.02, "jitter_s": 0.01, "cut": false}. Delay and jitter (uniform) are for
each direction; frames keep their order, as in a queue. It ends with its stdin.
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

from snakesim_hal.base.process import HOST_PRIORITY, set_realtime_priority

TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
CLONE_NEWNET = 0x40000000
FRAME_BYTES = 65536


def interface(pid: str, name: str) -> int:
    """A TAP interface in the namespace of a process, which this process is in afterwards."""
    libc = ctypes.CDLL(None, use_errno=True)
    namespace = os.open(f"/proc/{pid}/ns/net", os.O_RDONLY)
    if libc.setns(namespace, CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "setns")
    os.close(namespace)
    tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TAP | IFF_NO_PI))
    return tap


class RelayDirection:
    """One direction."""

    def __init__(self, source: int, sink: int) -> None:
        self.source, self.sink = source, sink
        self.waiting: deque[tuple[float, bytes]] = deque()

    def take(self, now: float, link: dict[str, float]) -> None:
        """Read what has come; decide its fate."""
        while True:
            try:
                frame = os.read(self.source, FRAME_BYTES)
            except OSError:  # none left, or the interface is down
                return
            if link["cut"] or random.random() < link["loss"]:
                continue
            due = now + link["delay_s"] + random.uniform(-1, 1) * link["jitter_s"]
            if self.waiting:
                due = max(due, self.waiting[-1][0])
            self.waiting.append((due, frame))

    def give(self, now: float) -> float:
        """Pass on what is due. Returns how long the next one has to wait."""
        while self.waiting and self.waiting[0][0] <= now:
            try:
                os.write(self.sink, self.waiting.popleft()[1])
            except OSError:
                continue
        return self.waiting[0][0] - now if self.waiting else 1.0


def main() -> None:
    """Until stdin is closed."""
    pid_a, pid_b, name = sys.argv[1:]
    a, b = interface(pid_a, name), interface(pid_b, name)
    set_realtime_priority(HOST_PRIORITY + 1)
    ways = RelayDirection(a, b), RelayDirection(b, a)
    link = {"loss": 0.0, "delay_s": 0.0, "jitter_s": 0.0, "cut": False}
    os.set_blocking(0, False)
    print("ready", flush=True)
    wait_s = 1.0
    while True:
        ready, _, _ = select.select([0, a, b], [], [], max(wait_s, 0.0))
        if 0 in ready:
            order = os.read(0, 65536)
            if not order:
                return
            for line in order.splitlines():
                link.update(json.loads(line))
        for way in ways:
            if way.source in ready:
                way.take(time.monotonic(), link)
        wait_s = min(way.give(time.monotonic()) for way in ways)


if __name__ == "__main__":
    main()
