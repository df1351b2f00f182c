"""A raw Zenoh echo between two processes: the least that any exchange of state and command can cost."""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import zenoh

from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_testing.harness.endpoint import find_free_endpoint

# Keys of the echo.
REQUEST = "bench/request"
REPLY = "bench/reply"
BLOCK = zenoh.CongestionControl.BLOCK
CONNECT_TIMEOUT_MS = 10000
START_TIMEOUT_S = 20.0  # for the other process to import Zenoh and to connect
ECHO_ROUNDS = 2000


def declare_publisher(
    session: zenoh.Session, key: str, congestion: zenoh.CongestionControl = BLOCK
) -> zenoh.Publisher:
    """Declare a publisher with the highest priority, as SnakeSIM's own publishers of state and commands have it."""
    return session.declare_publisher(
        key, express=True, priority=zenoh.Priority.REAL_TIME, congestion_control=congestion
    )


def answer_requests(
    session: zenoh.Session, reply: bytes, congestion: zenoh.CongestionControl = BLOCK
) -> None:
    """Send the reply for every request, until the process is killed."""
    publisher = declare_publisher(session, REPLY, congestion)
    # A temporary one would be closed.
    requests = session.declare_subscriber(REQUEST, zenoh.handlers.FifoChannel(16))
    for _ in requests:
        publisher.put(reply)


def measure_echo_us(
    request: bytes, reply: bytes, round_count: int = ECHO_ROUNDS, period_s: float = 0.0
) -> float:
    """Return the median round trip of `measure_echo_times_us`."""
    return statistics.median(measure_echo_times_us(request, reply, round_count, period_s))


def measure_echo_times_us(
    request: bytes, reply: bytes, round_count: int, period_s: float, prefix: Sequence[str] = ()
) -> list[float]:
    """Measure round trips to another process, in µs.

    Args:
        request: the bytes on the way there.
        reply: bytes on the way back; only their number counts.
        round_count: number of round trips.
        period_s: time between two requests; 0.0: each follows the reply to the one before.
        prefix: words before the command that starts the other process, such as `chrt -f 40`.

    Raises:
        TimeoutError: the other process does not answer.
    """
    endpoint = find_free_endpoint()
    with zenoh.open(_make_zenoh_config(endpoint, listen=True)) as session:
        publisher = declare_publisher(session, REQUEST)
        replies = session.declare_subscriber(REPLY, zenoh.handlers.RingChannel(4))
        command = make_python_command("-m", "benchmarks.echo", endpoint, str(len(reply)))
        echo_process = subprocess.Popen([*prefix, *command], env=make_child_environment())
        try:
            _wait_for_first_reply(publisher, replies, request)
            times_us: list[float] = []
            for _ in range(round_count):
                begin_s = time.perf_counter()
                publisher.put(request)
                replies.recv()
                times_us.append((time.perf_counter() - begin_s) * 1e6)
                time.sleep(max(begin_s + period_s - time.perf_counter(), 0.0))
        finally:
            echo_process.kill()
            echo_process.wait()
    return times_us


def _make_zenoh_config(endpoint: str, *, listen: bool) -> zenoh.Config:
    """Return the configuration of a session that listens at the endpoint, or of one that connects to it."""
    if listen:
        mode = "router"
        listen_endpoints = [endpoint]
        connect_endpoints = []
    else:
        mode = "client"
        listen_endpoints = []
        connect_endpoints = [endpoint]
    settings = {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "listen": {"endpoints": listen_endpoints},
        "connect": {"endpoints": connect_endpoints, "timeout_ms": CONNECT_TIMEOUT_MS},
    }
    return zenoh.Config.from_json5(json.dumps(settings))


def _wait_for_first_reply(publisher: zenoh.Publisher, replies: Any, request: bytes) -> None:
    """Repeat the request until the other process answers, and drop the replies to the repetitions."""
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while replies.try_recv() is None:
        if time.monotonic() > deadline_s:
            raise TimeoutError("the echo process does not answer")
        publisher.put(request)
        time.sleep(0.01)
    time.sleep(0.1)
    while replies.try_recv() is not None:
        pass


if __name__ == "__main__":
    with zenoh.open(_make_zenoh_config(sys.argv[1], listen=False)) as client_session:
        answer_requests(client_session, bytes(int(sys.argv[2])))
