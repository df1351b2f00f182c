"""`python -m verification.fuzz.writer ENDPOINT NAMESPACE PAYLOADS RATE SEED`: a stranger on a robot's network.

He sends what nobody should send, so many payloads a second. He listens for a moment first, so that it resembles what
this robot says: its layout, its live lease.
"""

import random
import sys
import time
from collections import Counter
from queue import Empty
from typing import Any

import msgspec
import zenoh
from msgspec import inspect

from snakesim_hal.base.errors import WireError
from snakesim_hal.model import fault_kinds as injection
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES, MessageDecoder
from snakesim_hal.wire.messages import Answer, JointCommand, Message
from verification.fuzz.payloads import SampleMaker, SeedMessage, seeds
from verification.fuzz.withheld import EffectiveSamples, HeldCommand

OVERHEAR_S = 2.0
SETTLE_S = 10.0
BATCH_S = 0.005
ASKED_AT_ONCE = 256  # queries without an answer yet
QUERY_S = 20.0
ELSEWHERE = 0.05  # of the samples go to a key that is not their message's
SERVICES = ("control", "guidance", "navigation", "nobody")
ODD_KEYS = (
    "**",
    "hal/*",
    "*/joints",
    "sensor/**",
    "hal/done/a/b",
    "actuator/joints/x",
    "alive/control",
    "\N{SNAKE}",
)
REQUESTS = [row.message for row in keys.SPACE if row.kind == "query"]
# Who asks there gets an answer, whatever was asked.
TO_HAL = keys.LEASE, keys.LIFECYCLE, keys.ESTOP
STREAMS = [row.key for row in keys.SPACE if row.kind in ("stream", "latched")]


class SentSample(msgspec.Struct, kw_only=True):
    """What the stranger did, and what came back."""

    seconds: float = 0.0
    samples: dict[str, int] = {}  # by key
    queries: dict[str, int] = {}
    by_mutation: dict[str, int] = {}
    withheld: dict[str, int] = {}  # valid and effective: never sent
    answers: dict[str, int] = {}  # yes, no, cannot be read, an error
    unanswered: int = 0  # queries to the HAL
    megabytes: float = 0.0


class SampleWriter:
    """Sends samples and asks queries."""

    def __init__(
        self, session: Session, rng: random.Random, heard: list[SeedMessage], live: HeldCommand
    ) -> None:
        self._zenoh = session._zenoh  # pyright: ignore[reportPrivateUsage] - a stranger does not keep to our session
        self._rng = rng
        self._maker = SampleMaker(rng, [*seeds(), *heard])
        self._withholding = EffectiveSamples(live)
        self._answer_decoder = MessageDecoder(Answer)
        self._open = 0
        self._closed: Mailbox[tuple[bool, list[str]]] = Mailbox()
        self._by: dict[str, Counter[str]] = {
            part: Counter() for part in ("samples", "queries", "by_mutation", "withheld", "answers")
        }
        self._bytes = 0
        self._to_hal = 0
        self._answered = 0

    def send(self, payload_count: int, rate: float) -> SentSample:
        """Send so many, that many a second."""
        started = time.monotonic()
        for number in range(payload_count):
            ahead = number / rate - (time.monotonic() - started)
            if ahead > BATCH_S:
                time.sleep(ahead)
            self._send_one()
        took = time.monotonic() - started
        give_up = time.monotonic() + SETTLE_S
        while self._open and time.monotonic() < give_up:
            self._collect(0.1)
        counts = {part: dict(counter) for part, counter in self._by.items()}
        return SentSample(
            seconds=took,
            unanswered=self._to_hal - self._answered,
            megabytes=self._bytes / 1e6,
            **counts,
        )

    def _send_one(self) -> None:
        while True:
            sample = self._maker.make()
            effect = self._withholding.effect(sample.payload, sample.encoding)
            if effect is None:
                break
            self._by["withheld"][effect] += 1
        key = self._key_of(sample.message)
        self._by["by_mutation"][sample.kind] += 1
        self._bytes += len(sample.payload)
        if sample.message in REQUESTS and self._rng.random() > ELSEWHERE:
            self._ask(key, sample.payload, sample.encoding)
            return
        self._by["samples"][key] += 1
        if self._rng.random() < 0.001:
            self._zenoh.delete(key)
            return
        self._zenoh.put(
            key,
            sample.payload,
            encoding=sample.encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _ask(self, key: str, payload: bytes, encoding: str) -> None:
        while self._open >= ASKED_AT_ONCE:
            self._collect(1.0)
        self._collect(0.0)
        self._by["queries"][key] += 1
        self._open += 1
        reported: list[str] = []

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                reported.append("an error")
                return
            try:
                answer = self._answer_decoder.decode(
                    reply.ok.payload.to_bytes(), str(reply.ok.encoding)
                )
                reported.append("yes" if answer.ok else "no")
            except WireError as error:
                reported.append(f"cannot be read: {error}"[:80])

        def close() -> None:
            self._closed.put((answerable, reported))

        selector = (
            key if self._rng.random() > 0.01 else f"{key}?{'x' * self._rng.randrange(300)}=;{{}}"
        )
        bare = self._rng.random() < 0.01
        # Longer ones are dropped on their way.
        answerable = key in TO_HAL and len(payload) <= MAX_PAYLOAD_BYTES
        self._to_hal += answerable
        self._zenoh.get(
            selector,
            zenoh.handlers.Callback(take, close),
            payload=None if bare else payload,
            encoding=None if bare else encoding,
            timeout=QUERY_S,
        )

    def _collect(self, wait_s: float) -> None:
        """Note the queries that have come to their end."""
        while self._open:
            try:
                to_hal, reported = (
                    self._closed.get(timeout=wait_s) if wait_s else self._closed.get_nowait()
                )
            except Empty:
                return
            wait_s = 0.0
            self._open -= 1
            self._answered += to_hal and bool(reported)
            self._by["answers"].update(reported)

    def _key_of(self, message: type[Message]) -> str:
        rng = self._rng
        if rng.random() < ELSEWHERE:
            key = rng.choice([*ODD_KEYS, *STREAMS])
        else:
            key = rng.choice([row.key for row in keys.SPACE if row.message is message] or STREAMS)
        if key == keys.FAULT_ALL:
            return keys.fault_key(rng.choice((injection.RUN, injection.HAL, *SERVICES)))
        if key in (keys.DEPTH_ALL, keys.COLOR_ALL, keys.RANGE_ALL):
            return key.replace("*", "head")
        return keys.done_key(rng.choice(SERVICES)) if key == keys.DONE_ALL else key


def overhear(connection: ConnectionSettings) -> tuple[list[SeedMessage], HeldCommand]:
    """One real message of every key on which this robot speaks, and what its controller holds."""
    arrivals: Mailbox[ReceivedSample] = Mailbox()
    with open_session(connection) as session:
        for key in STREAMS:
            latched = key in (keys.STATUS, keys.DESCRIPTION)
            (session.on_latched_arrival if latched else session.on_arrival)(key, arrivals.put)
        time.sleep(OVERHEAR_S)
    newest: dict[str, ReceivedSample] = {}
    while not arrivals.empty():
        arrival = arrivals.get()
        newest[arrival.key] = arrival
    found: list[SeedMessage] = []
    live: HeldCommand | None = None
    for key, arrival in newest.items():
        message = keys.find_message(key)
        assert message is not None
        real: Any = MessageDecoder(message).decode(arrival.payload, arrival.encoding)
        plain: dict[str, Any] = msgspec.to_builtins(real)
        found.append(
            SeedMessage(
                message, plain, arrival.payload, [((name,), inspect.AnyType()) for name in plain]
            )
        )
        if isinstance(real, JointCommand):
            live = HeldCommand(real.lease_epoch, real.sequence)
    assert live is not None, f"nobody commands this robot; heard only {', '.join(newest)}"
    return found, live


def main() -> int:
    """Prints what was sent as JSON."""
    endpoint, namespace, payloads, rate, seed = sys.argv[1:]
    link = ConnectionSettings(endpoint, namespace)
    heard, live = overhear(link)
    with open_session(link) as session:
        sent = SampleWriter(session, random.Random(int(seed)), heard, live).send(
            int(payloads), float(rate)
        )
    sys.stdout.buffer.write(msgspec.json.encode(sent))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
