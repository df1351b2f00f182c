"""An unauthorized client on a robot's network, which sends invalid payloads to every key and asks every query.

`network.py` starts it as `python -m verification.fuzz.fuzz_client ENDPOINT NAMESPACE PAYLOADS RATE_HZ SEED`. It first
listens for a moment, so that its payloads resemble those of this robot: its number of joints, its lease. In the end it
prints a `ClientReport` as JSON.
"""

import random
import sys
import time
from collections import Counter
from queue import Empty
from typing import Any

import msgspec
import zenoh

from snakesim_hal.base.errors import WireError
from snakesim_hal.model import fault_kinds
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES, MessageDecoder
from snakesim_hal.wire.messages import Answer, JointCommand, Message
from verification.fuzz.effects import EffectDetector, HeldCommand
from verification.fuzz.payloads import (
    FuzzSample,
    SampleMaker,
    SeedMessage,
    make_seed_messages,
    make_seed_of_fields,
)

LISTENING_S = 2.0
MAX_SETTLING_S = 10.0  # after the last payload, until open queries are given up
MIN_SLEEP_S = 0.005  # below it, the client sends ahead of its rate
MAX_OPEN_QUERIES = 256
QUERY_TIMEOUT_S = 20.0
OTHER_KEY_PROBABILITY = 0.05  # of a payload that goes to a key that is not its message's
DELETE_PROBABILITY = 0.001  # of a deletion of the key in place of a sample
ODD_SELECTOR_PROBABILITY = 0.01  # of a query with unknown parameters
EMPTY_QUERY_PROBABILITY = 0.01  # of a query without a payload
MAX_PARAMETER_CHARACTERS = 300
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
QUERY_MESSAGES = [row.message for row in keys.SPACE if row.kind == "query"]
# The HAL answers every query on these keys, even an invalid one.
ANSWERED_KEYS = keys.LEASE, keys.LIFECYCLE, keys.ESTOP
STREAM_KEYS = [row.key for row in keys.SPACE if row.kind in ("stream", "latched")]


class ClientReport(msgspec.Struct, kw_only=True):
    """What the client sent, and which answers it got."""

    duration_s: float = 0.0
    samples_by_key: dict[str, int] = {}
    queries_by_key: dict[str, int] = {}
    payloads_by_mutation: dict[str, int] = {}
    withheld_by_effect: dict[str, int] = {}  # valid and effective, and therefore not sent
    answers: dict[str, int] = {}  # yes, no, an error, or why an answer cannot be decoded
    unanswered_count: int = 0  # of queries that the HAL must answer
    sent_mb: float = 0.0


class FuzzClient:
    """Sends samples and asks queries at a rate."""

    def __init__(
        self,
        session: Session,
        rng: random.Random,
        overheard: list[SeedMessage],
        held: HeldCommand,
    ) -> None:
        """Create the client.

        Args:
            session: A session on the network of the robot.
            rng: The random numbers that select payloads and keys.
            overheard: Messages of this robot.
            held: The lease that must not be used.
        """
        # An unauthorized client is not limited to what our session sends.
        self._zenoh = session._zenoh  # pyright: ignore[reportPrivateUsage]
        self._rng = rng
        self._maker = SampleMaker(rng, [*make_seed_messages(), *overheard])
        self._effects = EffectDetector(held)
        self._answer_decoder = MessageDecoder(Answer)
        # Queries. Each item of the mailbox is a query that has ended: whether the HAL must answer it, and its answers.
        self._open_query_count = 0
        self._ended_queries: Mailbox[tuple[bool, list[str]]] = Mailbox()
        self._answerable_count = 0
        self._answered_count = 0
        # What was sent.
        self._samples_by_key: Counter[str] = Counter()
        self._queries_by_key: Counter[str] = Counter()
        self._payloads_by_mutation: Counter[str] = Counter()
        self._withheld_by_effect: Counter[str] = Counter()
        self._answers: Counter[str] = Counter()
        self._sent_bytes = 0

    def send_payloads(self, payload_count: int, rate_hz: float) -> ClientReport:
        """Send a number of payloads at a rate, and wait until the queries among them have ended."""
        start_s = time.monotonic()
        for number in range(payload_count):
            ahead_s = number / rate_hz - (time.monotonic() - start_s)
            if ahead_s > MIN_SLEEP_S:
                time.sleep(ahead_s)
            self._send_payload(self._make_harmless_sample())
        duration_s = time.monotonic() - start_s
        deadline_s = time.monotonic() + MAX_SETTLING_S
        while self._open_query_count and time.monotonic() < deadline_s:
            self._count_ended_queries(0.1)
        return ClientReport(
            duration_s=duration_s,
            samples_by_key=dict(self._samples_by_key),
            queries_by_key=dict(self._queries_by_key),
            payloads_by_mutation=dict(self._payloads_by_mutation),
            withheld_by_effect=dict(self._withheld_by_effect),
            answers=dict(self._answers),
            unanswered_count=self._answerable_count - self._answered_count,
            sent_mb=self._sent_bytes / 1e6,
        )

    def _make_harmless_sample(self) -> FuzzSample:
        """Make samples until one has no rightful effect."""
        while True:
            sample = self._maker.make_sample()
            effect = self._effects.describe_effect(sample.payload, sample.encoding)
            if effect is None:
                return sample
            self._withheld_by_effect[effect] += 1

    def _send_payload(self, sample: FuzzSample) -> None:
        """Send a payload as a query or as a sample."""
        key = self._choose_key(sample.message)
        self._payloads_by_mutation[sample.mutation] += 1
        self._sent_bytes += len(sample.payload)
        if sample.message in QUERY_MESSAGES and self._rng.random() > OTHER_KEY_PROBABILITY:
            self._ask_query(key, sample.payload, sample.encoding)
            return
        self._samples_by_key[key] += 1
        if self._rng.random() < DELETE_PROBABILITY:
            self._zenoh.delete(key)
            return
        self._zenoh.put(
            key,
            sample.payload,
            encoding=sample.encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _ask_query(self, key: str, payload: bytes, encoding: str) -> None:
        """Ask a query, once fewer than MAX_OPEN_QUERIES are open. Its end is counted later."""
        while self._open_query_count >= MAX_OPEN_QUERIES:
            self._count_ended_queries(1.0)
        self._count_ended_queries(0.0)
        self._queries_by_key[key] += 1
        self._open_query_count += 1
        selector = key
        if self._rng.random() <= ODD_SELECTOR_PROBABILITY:
            selector = f"{key}?{'x' * self._rng.randrange(MAX_PARAMETER_CHARACTERS)}=;{{}}"
        is_empty = self._rng.random() < EMPTY_QUERY_PROBABILITY
        # Longer payloads are dropped on their way.
        is_answerable = key in ANSWERED_KEYS and len(payload) <= MAX_PAYLOAD_BYTES
        self._answerable_count += is_answerable
        answers: list[str] = []

        def note_reply(reply: zenoh.Reply) -> None:
            answers.append(self._describe_reply(reply))

        def note_end() -> None:
            self._ended_queries.put((is_answerable, answers))

        self._zenoh.get(
            selector,
            zenoh.handlers.Callback(note_reply, note_end),
            payload=None if is_empty else payload,
            encoding=None if is_empty else encoding,
            timeout=QUERY_TIMEOUT_S,
        )

    def _describe_reply(self, reply: zenoh.Reply) -> str:
        if reply.ok is None:
            return "an error"
        try:
            answer = self._answer_decoder.decode(
                reply.ok.payload.to_bytes(), str(reply.ok.encoding)
            )
        except WireError as error:
            return f"cannot be decoded: {error}"[:80]
        return "yes" if answer.ok else "no"

    def _count_ended_queries(self, timeout_s: float) -> None:
        """Count the queries that have ended, and wait up to `timeout_s` for the first of them."""
        while self._open_query_count:
            try:
                if timeout_s:
                    is_answerable, answers = self._ended_queries.get(timeout=timeout_s)
                else:
                    is_answerable, answers = self._ended_queries.get_nowait()
            except Empty:
                return
            timeout_s = 0.0
            self._open_query_count -= 1
            self._answered_count += is_answerable and bool(answers)
            self._answers.update(answers)

    def _choose_key(self, message: type[Message]) -> str:
        """Choose a key of the message, or now and then another one."""
        rng = self._rng
        if rng.random() < OTHER_KEY_PROBABILITY:
            key = rng.choice([*ODD_KEYS, *STREAM_KEYS])
        else:
            keys_of_message = [row.key for row in keys.SPACE if row.message is message]
            key = rng.choice(keys_of_message or STREAM_KEYS)
        match key:
            case keys.FAULT_ALL:
                return keys.fault_key(rng.choice((fault_kinds.RUN, fault_kinds.HAL, *SERVICES)))
            case keys.DEPTH_ALL | keys.COLOR_ALL | keys.RANGE_ALL:
                return key.replace("*", "head")
            case keys.DONE_ALL:
                return keys.done_key(rng.choice(SERVICES))
            case _:
                return key


def overhear(connection: ConnectionSettings) -> tuple[list[SeedMessage], HeldCommand]:
    """Receive the newest message on every key of a running robot, and the lease of its controller."""
    arrivals: Mailbox[ReceivedSample] = Mailbox()
    with open_session(connection) as session:
        for key in STREAM_KEYS:
            if key in (keys.STATUS, keys.DESCRIPTION):
                session.on_latched_arrival(key, arrivals.put)
            else:
                session.on_arrival(key, arrivals.put)
        time.sleep(LISTENING_S)
    newest_by_key: dict[str, ReceivedSample] = {}
    while not arrivals.empty():
        arrival = arrivals.get()
        newest_by_key[arrival.key] = arrival
    overheard: list[SeedMessage] = []
    held: HeldCommand | None = None
    for key, arrival in newest_by_key.items():
        message_type = keys.find_message(key)
        assert message_type is not None
        message: Any = MessageDecoder(message_type).decode(arrival.payload, arrival.encoding)
        fields: dict[str, Any] = msgspec.to_builtins(message)
        overheard.append(make_seed_of_fields(message_type, fields, arrival.payload))
        if isinstance(message, JointCommand):
            held = HeldCommand(message.lease_epoch, message.sequence)
    assert held is not None, (
        f"no controller commands this robot; there are messages only on {', '.join(newest_by_key)}"
    )
    return overheard, held


def main() -> int:
    """Send the payloads, and print the report as JSON."""
    endpoint, namespace, payload_count, rate_hz, seed = sys.argv[1:]
    connection = ConnectionSettings(endpoint, namespace)
    overheard, held = overhear(connection)
    with open_session(connection) as session:
        client = FuzzClient(session, random.Random(int(seed)), overheard, held)
        report = client.send_payloads(int(payload_count), float(rate_hz))
    sys.stdout.buffer.write(msgspec.json.encode(report))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
