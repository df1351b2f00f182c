"""A raw Zenoh echo between two processes: the least that any exchange of state and command can cost."""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence

import zenoh

from snakesim_hal.base.process import child_environment, python_command
from snakesim_testing.harness.endpoint import free_endpoint

REQUEST, REPLY = "bench/request", "bench/reply"
BLOCK = zenoh.CongestionControl.BLOCK


def _config(endpoint: str, *, listen: bool) -> zenoh.Config:
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "router" if listen else "client",
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                "listen": {"endpoints": [endpoint] if listen else []},
                "connect": {"endpoints": [] if listen else [endpoint], "timeout_ms": 10000},
            }
        )
    )


def publisher_of(session: zenoh.Session, key: str, congestion: zenoh.CongestionControl = BLOCK) -> zenoh.Publisher:
    """Of what nothing else is as urgent as."""
    return session.declare_publisher(
        key, express=True, priority=zenoh.Priority.REAL_TIME, congestion_control=congestion
    )


def answer(session: zenoh.Session, reply: bytes, congestion: zenoh.CongestionControl = BLOCK) -> None:
    """Answer every request, until somebody ends this process."""
    publisher = publisher_of(session, REPLY, congestion)
    requests = session.declare_subscriber(REQUEST, zenoh.handlers.FifoChannel(16))  # a temporary one would be closed
    for _ in requests:
        publisher.put(reply)


def echo_us(request: bytes, reply: bytes, rounds: int = 2000, period_s: float = 0.0) -> float:
    """Median round trip of `request` one way and `reply` back, in microseconds; one every `period_s`."""
    return statistics.median(echo_times_us(request, reply, rounds, period_s))


def echo_times_us(
    request: bytes, reply: bytes, rounds: int, period_s: float, prefix: Sequence[str] = ()
) -> list[float]:
    """Every round trip. prefix: of the command that starts the other process."""
    endpoint = free_endpoint()
    with zenoh.open(_config(endpoint, listen=True)) as session:
        publisher = publisher_of(session, REQUEST)
        replies = session.declare_subscriber(REPLY, zenoh.handlers.RingChannel(4))
        command = python_command("-m", "benchmarks.echo", endpoint, str(len(reply)))
        other = subprocess.Popen([*prefix, *command], env=child_environment())
        try:
            deadline = time.monotonic() + 20
            while replies.try_recv() is None:  # until the other side answers
                if time.monotonic() > deadline:
                    raise TimeoutError("the echo process does not answer")
                publisher.put(request)
                time.sleep(0.01)
            time.sleep(0.1)
            while replies.try_recv() is not None:
                pass
            times: list[float] = []
            for _ in range(rounds):
                begin = time.perf_counter()
                publisher.put(request)
                replies.recv()
                times.append((time.perf_counter() - begin) * 1e6)
                time.sleep(max(begin + period_s - time.perf_counter(), 0.0))
        finally:
            other.kill()
            other.wait()
    return times


if __name__ == "__main__":
    with zenoh.open(_config(sys.argv[1], listen=False)) as joined:
        answer(joined, bytes(int(sys.argv[2])))
