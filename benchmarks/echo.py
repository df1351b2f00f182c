"""A raw Zenoh echo between two processes: the least that any exchange of state and command can cost."""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence

import zenoh

from tests.harness.endpoint import free_endpoint

REQUEST, REPLY = "bench/request", "bench/reply"


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


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(
        key, express=True, priority=zenoh.Priority.REAL_TIME, congestion_control=zenoh.CongestionControl.BLOCK
    )


def echo_us(request: bytes, reply: bytes, rounds: int = 2000, period_s: float = 0.0) -> float:
    """Median round trip of `request` one way and `reply` back, in microseconds; one every `period_s`."""
    return statistics.median(echo_times_us(request, reply, rounds, period_s))


def echo_times_us(
    request: bytes, reply: bytes, rounds: int, period_s: float, prefix: Sequence[str] = ()
) -> list[float]:
    """Every round trip. prefix: of the command that starts the other process."""
    endpoint = free_endpoint()
    with zenoh.open(_config(endpoint, listen=True)) as session:
        publisher = _publisher(session, REQUEST)
        replies = session.declare_subscriber(REPLY, zenoh.handlers.RingChannel(4))
        other = subprocess.Popen([*prefix, sys.executable, "-m", "benchmarks.echo", endpoint, str(len(reply))])
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


def _answer(endpoint: str, reply_bytes: int) -> None:
    reply = bytes(reply_bytes)
    with zenoh.open(_config(endpoint, listen=False)) as session:
        publisher = _publisher(session, REPLY)
        requests = session.declare_subscriber(REQUEST, zenoh.handlers.FifoChannel(16))
        for _ in requests:
            publisher.put(reply)


if __name__ == "__main__":
    _answer(sys.argv[1], int(sys.argv[2]))
