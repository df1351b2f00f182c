"""Payloads that nobody should send: valid ones with one thing wrong, or with everything wrong."""

import datetime
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from msgspec import inspect
from msgspec.msgpack import Ext

from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES, encode, format_encoding
from snakesim_hal.wire.messages import (
    VERSIONS,
    JointCommand,
    JointState,
    LeaseRequest,
    LifecycleRequest,
    Message,
)
from snakesim_testing.hal.small_robots import (
    LEASE_NS,
    make_description,
    make_joint_command,
    make_joint_state,
)
from snakesim_testing.hal.strategies import (
    Place,
    iter_places,
    list_invalid_values,
    make_plain_example,
    replace_at,
)
from verification.fuzz.texts import flipped

ROBOT = make_description()
REAL: dict[type[Message], list[Message]] = {
    JointState: [make_joint_state(ROBOT, 0.1)],
    JointCommand: [
        make_joint_command(ROBOT, 0.1, sequence=10**6),
        make_joint_command(ROBOT, 0.1, lease_epoch=2, torque_limit_nm=[1.0] * 3),
    ],
    LeaseRequest: [
        LeaseRequest(action=action, holder="control", epoch=1)
        for action in ("acquire", "renew", "release")
    ],
    LifecycleRequest: [
        LifecycleRequest(action=action, robot="worm", backend="lag", config_hash=ROBOT.config_hash)
        for action in ("arm", "disarm", "reset", "finish")
    ],
}
LONG = 100_000
WEIRD: list[Any] = [
    None,
    True,
    -1,
    2**63,
    2**64 - 1,
    -(2**63),
    0.5,
    float("nan"),
    float("inf"),
    -1e308,
    5e-324,
    "",
    "\x00",
    "x" * 65,
    "ж" * 501,
    "x" * LONG,
    b"\xff\xfe",
    b"x" * LONG,
    [],
    {},
    [None],
    [[[[[[]]]]]],
    {1: 2},
    {None: [None]},
    {"": {"": {}}},
    [0.0] * 257,
    [0] * LONG,
    [[]] * 1000,
    {str(i): i for i in range(1000)},
    Ext(5, b"x"),
    Ext(-128, b""),
    datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC),
    LEASE_NS,
]
HEADS = [
    bytes([code])
    for code in (0xDC, 0xDD, 0xDE, 0xDF, 0xD9, 0xDA, 0xDB, 0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9)
]
NESTS = [
    b"\x91",
    b"\x81\xa1a",
    b"\x81\xa5other",
    b"\x81\x91",
    b"\xdd\x00\x00\x00\x01",
    b"\x92\xc0",
    b"\x81\xa8contacts\x91",
]
RARE = 500  # one in so many is as large as a payload may be, or larger


@dataclass(frozen=True)
class SeedMessage:
    """A valid message to start from."""

    message: type[Message]
    plain: dict[str, Any]
    payload: bytes
    places: list[tuple[Place, inspect.Type]]


@dataclass(frozen=True)
class FuzzSample:
    """What arrives at the decoder of a message."""

    message: type[Message]
    kind: str  # what was done to a valid payload
    payload: bytes
    encoding: str


def seeds() -> list[SeedMessage]:
    """At least one of every message that may stand alone on the wire."""
    found: list[SeedMessage] = []
    for message in VERSIONS:
        plain = make_plain_example(message)
        found.append(
            SeedMessage(
                message, plain, encode(plain), list(iter_places(plain, inspect.type_info(message)))
            )
        )
        for real in REAL.get(message, []):
            plain: dict[str, Any] = {name: getattr(real, name) for name in real.__struct_fields__}
            found.append(
                SeedMessage(
                    message, plain, encode(real), [((name,), inspect.AnyType()) for name in plain]
                )
            )
    return found


class SampleMaker:
    """Makes one sample after the other; the same ones for the same random numbers."""

    def __init__(self, rng: random.Random, start_from: Sequence[SeedMessage] | None = None) -> None:
        """start_from: valid messages to make others of; None: `seeds()`."""
        self._rng = rng
        self._seeds = list(start_from or seeds())
        self._kinds: dict[str, Callable[[SeedMessage], bytes]] = {
            "valid": lambda seed: seed.payload,
            "random": lambda seed: rng.randbytes(rng.randrange(200)),
            "truncated": lambda seed: seed.payload[: rng.randrange(len(seed.payload))],
            "bit-flipped": lambda seed: flipped(rng, seed.payload),
            "spliced": self._spliced,
            "type-confused": self._confused,
            "fields lost": self._lost,
            "huge length": self._huge_length,
            "huge": self._huge,
            "nested": self._nested,
            "other message": lambda seed: rng.choice(self._seeds).payload,
        }

    def make(self) -> FuzzSample:
        """The next sample."""
        rng = self._rng
        seed = rng.choice(self._seeds)
        kind = rng.choice(list(self._kinds))
        encoding = format_encoding(seed.message)
        if rng.random() < 0.02:
            at = rng.randrange(len(encoding))
            encoding = rng.choice(
                [encoding[:at], encoding + "0", encoding[:at] + chr(rng.randrange(1, 0xD800)), ""]
            )
        return FuzzSample(seed.message, kind, self._kinds[kind](seed), encoding)

    def _spliced(self, seed: SeedMessage) -> bytes:
        one, other = seed.payload, self._rng.choice(self._seeds).payload
        at, since = self._rng.randrange(len(one)), self._rng.randrange(len(other))
        return (
            one[:at]
            + other[since : since + self._rng.randrange(60)]
            + one[at + self._rng.randrange(10) :]
        )

    def _confused(self, seed: SeedMessage) -> bytes:
        at, info = self._rng.choice(seed.places)
        wrong = list_invalid_values(info)
        value = (
            self._rng.choice(wrong)
            if wrong and self._rng.random() < 0.5
            else self._rng.choice(WEIRD)
        )
        return encode(replace_at(seed.plain, at, value))

    def _lost(self, seed: SeedMessage) -> bytes:
        return encode(
            {name: value for name, value in seed.plain.items() if self._rng.random() < 0.8}
        )

    def _huge_length(self, seed: SeedMessage) -> bytes:
        at = self._rng.randrange(len(seed.payload))
        length = self._rng.choice(
            (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x10\x00\x00", b"\xff\xff", b"\xff")
        )
        return seed.payload[:at] + self._rng.choice(HEADS) + length + seed.payload[at:]

    def _huge(self, seed: SeedMessage) -> bytes:
        count = self._rng.choice((2_000, 20_000))
        if self._rng.random() < 1 / RARE:
            count = self._rng.choice((MAX_PAYLOAD_BYTES // 9, MAX_PAYLOAD_BYTES))
        entry = self._rng.choice((b"\xcb" + bytes(8), b"\xa1a", b"\xc3", b"\x90", b"\x80", b"\x00"))
        body = b"\xdd" + count.to_bytes(4, "big") + entry * count
        name = self._rng.choice(["other", *seed.plain])
        rest = {key: value for key, value in seed.plain.items() if key != name}
        head = bytes([0x80 + min(len(rest) + 1, 15)])
        return head + encode(name) + body + encode(rest)[1:]

    def _nested(self, seed: SeedMessage) -> bytes:
        depth = self._rng.choice((10, 100, 1_000, 5_000))
        if self._rng.random() < 1 / RARE:
            depth = MAX_PAYLOAD_BYTES // 9
        nest = self._rng.choice(NESTS) * depth
        if self._rng.random() < 0.5:
            return nest + b"\xc0"
        name = self._rng.choice(["other", *seed.plain])
        return b"\x82" + encode(name) + nest + b"\xc0" + seed.payload[1:]
