"""One process of the raw echo, or a router, on a machine of the lab: `python -m benchmarks.paths.raw PART FILE ...`."""

import argparse
import json
import sys
import threading
import time
from pathlib import Path
from queue import Empty, SimpleQueue

import zenoh

from benchmarks.echo import REPLY, REQUEST, answer_requests, declare_publisher
from snakesim_hal.base.process import SERVICE_PRIORITY, set_realtime_priority

DROP = zenoh.CongestionControl.DROP
PERIOD_S, WARM_UP = 0.01, 100
LOST_S = 1.0


def main() -> None:
    """Ends by itself only when it asks."""
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=["router", "answer", "ask", "read"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--bytes", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=0)
    parser.add_argument("--key", default="")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if arguments.part != "read":
        set_realtime_priority(SERVICE_PRIORITY)
    zenoh.init_log_from_env_or("error")
    sys.setswitchinterval(0.0005)
    with zenoh.open(zenoh.Config.from_file(arguments.file)) as session:
        if arguments.part == "answer":
            answer_requests(session, bytes(arguments.bytes), DROP)
        elif arguments.part == "ask":
            arguments.out.write_text(
                json.dumps(_ask(session, bytes(arguments.bytes), arguments.rounds))
            )
        elif arguments.part == "read":
            _read(session, arguments.key, arguments.out)
        else:
            threading.Event().wait()


def _ask(session: zenoh.Session, request: bytes, round_count: int) -> list[float]:
    """Every round trip in microseconds, one every `PERIOD_S`; a lost one counts as a second."""
    publisher = declare_publisher(session, REQUEST, DROP)
    replies: SimpleQueue[zenoh.Sample] = SimpleQueue()
    _kept = session.declare_subscriber(REPLY, replies.put)
    times: list[float] = []
    while len(times) < WARM_UP + round_count:
        began = time.perf_counter()
        publisher.put(request)
        answered = True
        try:
            replies.get(timeout=LOST_S)
        except Empty:
            answered = False
        if answered or times:  # until the other side is there
            times.append((time.perf_counter() - began) * 1e6)
        time.sleep(max(began + PERIOD_S - time.perf_counter(), 0.0))
    return times[WARM_UP:]


def _read(session: zenoh.Session, key: str, out: Path) -> None:
    """Count what comes: twice a second the number of samples and of bytes."""
    count = size = 0
    shown = time.monotonic()
    samples = session.declare_subscriber(key, zenoh.handlers.RingChannel(256))
    for sample in samples:
        count, size = count + 1, size + len(sample.payload)
        if time.monotonic() - shown > 0.5:
            shown = time.monotonic()
            out.write_text(json.dumps([count, size]))


if __name__ == "__main__":
    main()
