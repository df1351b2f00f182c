"""What runs at the far end of the link of `benchmarks.bandwidth`: one reader of a robot's keys, or one end of an echo.

`python -m benchmarks.far read ENDPOINT KEY SECONDS` and `... ping ENDPOINT BYTES SECONDS` print one line of JSON;
`... pong ENDPOINT BYTES` and `... watch ENDPOINT KEY` go on until they are killed.
"""

import json
import sys
import time
from pathlib import Path

import msgspec
import zenoh
from zenoh import handlers  # pyright: ignore[reportMissingModuleSource]

from benchmarks.echo import REPLY, REQUEST
from snakesim_hal.process import SERVICE_PRIORITY, set_realtime_priority

PING_HZ = 100.0
SETTLE_S = 1.5


def session_at(endpoint: str) -> zenoh.Session:
    """A client, as any viewer is."""
    settings = {
        "mode": "client",
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "connect": {"endpoints": [endpoint], "timeout_ms": 20000},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """As commands are sent in real time."""
    drop = zenoh.CongestionControl.DROP
    return session.declare_publisher(key, express=True, priority=zenoh.Priority.REAL_TIME, congestion_control=drop)


def link_bytes() -> int:
    """Bytes that the links of this network namespace, but loopback, have carried both ways, with Ethernet headers."""
    total = 0
    for line in Path("/proc/self/net/dev").read_text().splitlines()[2:]:
        name, _, numbers = line.partition(":")
        if name.strip() != "lo":
            fields = numbers.split()
            total += int(fields[0]) + int(fields[8])
    return total


def read(endpoint: str, key: str, seconds: float) -> dict[str, float | int | None]:
    """Subscribe to one key alone. `robot_s`: robot time between the first and the last message, if they carry it."""
    sizes: list[int] = []
    ticks: list[int] = []

    def take(sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        sizes.append(len(payload))
        ticks.append(msgspec.msgpack.decode(payload).get("tick", -1))

    with session_at(endpoint) as session:
        subscriber = session.declare_subscriber(f"*/{key}", take)
        time.sleep(SETTLE_S)
        sizes.clear()
        ticks.clear()
        before, start = link_bytes(), time.monotonic()
        time.sleep(seconds)
        wire, wall_s = link_bytes() - before, time.monotonic() - start
        counted, bytes_in, seen = len(sizes), sum(sizes), list(ticks)
        subscriber.undeclare()
    moved = max(seen) - min(seen) if seen and min(seen) >= 0 else None
    return {"messages": counted, "payload": bytes_in, "wire": wire, "wall_s": wall_s, "ticks": moved}


def watch(endpoint: str, key: str) -> None:
    """A viewer that reads a key and does nothing with it."""
    with session_at(endpoint) as session:
        _subscriber = session.declare_subscriber(f"*/{key}", handlers.RingChannel(1))
        time.sleep(1e6)


def pong(endpoint: str, size: int) -> None:
    """Answer every request, as a controller does."""
    with session_at(endpoint) as session:
        publisher, reply = _publisher(session, REPLY), bytes(size)
        requests = session.declare_subscriber(REQUEST)
        for request in requests:
            publisher.put(reply[:-8] + request.payload.to_bytes()[:8])


def ping(endpoint: str, size: int, seconds: float) -> dict[str, list[float] | int]:
    """Round trips in milliseconds, one every 10 ms, and how many never came back."""
    sent: dict[int, float] = {}
    took: list[float] = []

    def take(sample: zenoh.Sample) -> None:
        at = sent.pop(int.from_bytes(sample.payload.to_bytes()[-8:], "little"), None)
        if at is not None:
            took.append((time.monotonic() - at) * 1000)

    def send(number: int) -> None:
        sent[number] = time.monotonic()
        publisher.put(number.to_bytes(8, "little") + bytes(size - 8))

    with session_at(endpoint) as session:
        publisher, subscriber = _publisher(session, REQUEST), session.declare_subscriber(REPLY, take)
        while not took:  # until the other end is there
            send(0)
            time.sleep(0.1)
        time.sleep(SETTLE_S)
        sent.clear()
        took.clear()
        begun = time.monotonic()
        for number in range(int(seconds * PING_HZ)):
            time.sleep(max(0.0, begun + number / PING_HZ - time.monotonic()))
            send(number)
        time.sleep(1.0)
        subscriber.undeclare()
        return {"took_ms": took, "lost": len(sent)}


def main() -> None:
    """Do what the command line says."""
    act, endpoint, *rest = sys.argv[1:]
    if act in ("ping", "pong"):
        set_realtime_priority(SERVICE_PRIORITY)  # as control has it
    if act == "read":
        print(json.dumps(read(endpoint, rest[0], float(rest[1]))))
    elif act == "ping":
        print(json.dumps(ping(endpoint, int(rest[0]), float(rest[1]))))
    elif act == "pong":
        pong(endpoint, int(rest[0]))
    else:
        watch(endpoint, rest[0])


if __name__ == "__main__":
    main()
