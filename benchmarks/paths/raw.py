"""Run one process of the raw echo, or a router, on a machine: `python -m benchmarks.paths.raw PART SESSION_FILE ...`.

The parts are: `ask` sends requests and measures their round trips, `answer` replies to them, `read` counts the samples
of a key, and `router` only forwards. Only `ask` ends without being stopped.
"""

import argparse
import json
import sys
import threading
import time
from pathlib import Path
from queue import Empty, SimpleQueue

import zenoh

from benchmarks.echo import REPLY, REQUEST, answer_requests, declare_publisher
from snakesim_hal.base.process import (
    SERVICE_PRIORITY,
    SWITCH_INTERVAL_S,
    set_realtime_priority,
)

DROP = zenoh.CongestionControl.DROP
PERIOD_S = 0.01
WARM_UP_ROUNDS = 100
REPLY_TIMEOUT_S = 1.0
COUNT_INTERVAL_S = 0.5
MAX_QUEUED_SAMPLES = 256


def main() -> None:
    """Open a session, and run the part that the command line names."""
    arguments = _parse_arguments()
    if arguments.part != "read":
        set_realtime_priority(SERVICE_PRIORITY)
    zenoh.init_log_from_env_or("error")
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    with zenoh.open(zenoh.Config.from_file(arguments.file)) as session:
        match arguments.part:
            case "answer":
                answer_requests(session, bytes(arguments.bytes), DROP)
            case "ask":
                request = bytes(arguments.bytes)
                times_us = measure_round_trips_us(session, request, arguments.rounds)
                arguments.out.write_text(json.dumps(times_us))
            case "read":
                count_samples(session, arguments.key, arguments.out)
            case _:
                threading.Event().wait()


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paths.raw", description=__doc__)
    parser.add_argument("part", choices=["router", "answer", "ask", "read"])
    parser.add_argument("file", type=Path, help="configuration of the Zenoh session")
    parser.add_argument("--bytes", type=int, default=0, help="size of a request or reply")
    parser.add_argument("--rounds", type=int, default=0, help="number of measured requests")
    parser.add_argument("--key", default="", help="key to read")
    parser.add_argument("--out", type=Path, help="file for the times in us, or for the counts")
    return parser.parse_args()


def measure_round_trips_us(session: zenoh.Session, request: bytes, round_count: int) -> list[float]:
    """Send a request every PERIOD_S, and return the time until each reply in microseconds.

    The first requests, until the other process answers and for WARM_UP_ROUNDS, are left out. A request without reply
    counts as REPLY_TIMEOUT_S.
    """
    publisher = declare_publisher(session, REQUEST, DROP)
    replies: SimpleQueue[zenoh.Sample] = SimpleQueue()
    _subscriber = session.declare_subscriber(REPLY, replies.put)  # a reference keeps it alive
    times_us: list[float] = []
    while len(times_us) < WARM_UP_ROUNDS + round_count:
        start_s = time.perf_counter()
        publisher.put(request)
        has_reply = True
        try:
            replies.get(timeout=REPLY_TIMEOUT_S)
        except Empty:
            has_reply = False
        is_connected = has_reply or bool(times_us)
        if is_connected:
            times_us.append((time.perf_counter() - start_s) * 1e6)
        time.sleep(max(start_s + PERIOD_S - time.perf_counter(), 0.0))
    return times_us[WARM_UP_ROUNDS:]


def count_samples(session: zenoh.Session, key: str, out: Path) -> None:
    """Count the samples of a key and their bytes, and write both numbers into a file twice a second."""
    byte_count = 0
    last_write_s = time.monotonic()
    samples = session.declare_subscriber(key, zenoh.handlers.RingChannel(MAX_QUEUED_SAMPLES))
    for sample_count, sample in enumerate(samples, 1):
        byte_count += len(sample.payload)
        if time.monotonic() - last_write_s > COUNT_INTERVAL_S:
            last_write_s = time.monotonic()
            out.write_text(json.dumps([sample_count, byte_count]))


if __name__ == "__main__":
    main()
