"""What floods or occupies a robot's network, as a process.

`python -m verification.attack.means.flooder KIND ENDPOINT AMOUNT`.

It prints "ready" when it is at work, and goes on until it is killed or its standard input closes.
"""

import os
import random
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import zenoh
from zenoh import handlers  # pyright: ignore[reportMissingModuleSource]

from verification.attack.means import wire
from verification.attack.stranger import NAMESPACE, settings


def idle(endpoint: str, amount: int) -> Iterator[str]:
    """Sessions that do nothing: as many as there may be, up to an amount."""
    kept: list[Any] = []
    while len(kept) < amount:
        try:
            kept.append(zenoh.open(settings(endpoint, timeout_s=1.0)))
        except zenoh.ZError:
            break
    yield f"ready: {len(kept)} sessions"
    while True:
        time.sleep(1.0)
        yield f"{len(kept)} sessions"


def lease(endpoint: str, amount: int) -> Iterator[str]:
    """Queries for the lease, so many a second or as many as this process can."""
    request = wire.encode({"action": "acquire", "holder": "flood", "priority": 0})
    yield from _queries(endpoint, amount, [("hal/lease", request, wire.encoding_of("hal/lease"))])


def noise(endpoint: str, amount: int) -> Iterator[str]:
    """Noise in queries to everything that answers."""
    dice = random.Random(1)
    shots = [
        (key.replace("*", "run"), dice.randbytes(200), wire.encoding_of(key))
        for key in wire.QUERIES
    ]
    yield from _queries(endpoint, amount, shots)


def _queries(endpoint: str, amount: int, shots: list[tuple[str, bytes, str]]) -> Iterator[str]:
    session = zenoh.open(settings(endpoint))
    sent, began = 0, time.monotonic()
    yield "ready"
    while True:
        for key, payload, encoding in shots:
            # A channel that nobody reads costs this process less than a callback.
            session.get(
                f"{NAMESPACE}/{key}",
                handlers.RingChannel(1),
                payload=payload,
                encoding=encoding,
                timeout=1.0,
            )
        sent += len(shots)
        ahead_s = sent / amount - (time.monotonic() - began)
        if ahead_s > 0:
            time.sleep(ahead_s)
        if sent % 1000 < len(shots):
            yield f"{sent / (time.monotonic() - began):.0f} queries a second"


def garbage(endpoint: str, amount: int) -> Iterator[str]:
    """Noise, and what has the right look and the wrong content, as samples on every key, so many a second."""
    dice, session = random.Random(1), zenoh.open(settings(endpoint))
    keys = [key.replace("*", "control") for key in wire.STREAMS]
    shots = [(f"{NAMESPACE}/{key}", wire.encoding_of(key)) for key in keys]
    payloads = [
        *(dice.randbytes(dice.choice((1, 30, 300, 3000))) for _ in range(50)),
        *(wire.deep(levels) for levels in (10, 1000, 100_000)),
        *(wire.encode({"tick": tick, "timestamp_ns": 0}) for tick in (0, 2**62)),
        wire.encode({str(i): i for i in range(1000)}),
    ]
    sent, began = 0, time.monotonic()
    while True:
        key, encoding = dice.choice(shots)
        session.put(key, dice.choice(payloads), encoding=encoding)
        sent += 1
        ahead_s = sent / amount - (time.monotonic() - began)
        if ahead_s > 0:
            time.sleep(ahead_s)
        if sent % 1000 == 0:
            yield (
                "ready"
                if sent == 1000
                else f"{sent / (time.monotonic() - began):.0f} samples a second"
            )


def readers(endpoint: str, amount: int) -> Iterator[str]:
    """Readers of patterns that match every key; when this process is killed they all leave at once."""
    session = zenoh.open(settings(endpoint))
    kept: list[Any] = []
    for i in range(amount):
        # Unread: no thread each.
        kept.append(session.declare_subscriber(pattern(i), handlers.RingChannel(1)))
    time.sleep(1.0)  # until the robot's host knows of them
    yield "ready"
    while True:
        time.sleep(1.0)
        yield f"{len(kept)} readers"


def pattern(i: int) -> str:
    """One of 1024 key expressions that match nearly every key of the robot, each in its own way."""
    bits, rest = i % 256, ("**", "*/**", "*/*", "*/*/**")[i // 256 % 4]
    letters = [letter if bits >> at & 1 else "$*" for at, letter in enumerate(NAMESPACE)]
    name = "".join(letters)
    while "$*$*" in name:
        name = name.replace("$*$*", "$*")
    return f"{'*' if name == '$*' else name}/{rest}"


def everything(endpoint: str, _amount: int) -> Iterator[str]:
    """One reader of everything, to be frozen. With a small buffer, so that it is full at once."""
    session = zenoh.open(settings(endpoint, receive_buffer=4096))
    heard: list[int] = []
    keep = session.declare_subscriber("**", lambda sample: heard.append(len(sample.payload)))
    while not heard:
        time.sleep(0.05)
    yield "ready"
    while True:
        time.sleep(1.0)
        heard.clear()
        yield f"{keep} goes on"


KINDS = {made.__name__: made for made in (idle, lease, noise, garbage, readers, everything)}


def main() -> None:
    """Until killed."""
    kind, endpoint, amount = sys.argv[1:4]
    zenoh.init_log_from_env_or("off")
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    for line in KINDS[kind](endpoint, int(amount)):
        print(line, flush=True)


if __name__ == "__main__":
    main()
