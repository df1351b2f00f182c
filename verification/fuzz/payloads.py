"""Makes invalid payloads of wire messages: valid ones with one thing wrong, or with everything wrong."""

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
from verification.fuzz.text_mutations import flip_bits

ROBOT = make_description()
# Messages that a HAL of ROBOT accepts or answers, in addition to the plain examples.
REALISTIC_MESSAGES: dict[type[Message], list[Message]] = {
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
LONG = 100_000  # characters, bytes or elements of a long value
UNUSUAL_VALUES: list[Any] = [
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
# First bytes in MessagePack of arrays, maps, strings, binaries and extensions whose length follows.
SIZED_TYPE_CODES = [
    bytes([code])
    for code in (0xDC, 0xDD, 0xDE, 0xDF, 0xD9, 0xDA, 0xDB, 0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9)
]
HUGE_LENGTHS = (
    b"\xff\xff\xff\xff",
    b"\x7f\xff\xff\xff",
    b"\x00\x10\x00\x00",
    b"\xff\xff",
    b"\xff",
)
ARRAY_32_CODE = b"\xdd"  # first byte of an array whose length has 32 bits
NIL = b"\xc0"
MAX_SHORT_MAP_ENTRIES = 15  # of a map whose first byte contains its length
SHORT_MAP_CODE = 0x80
# Beginnings of arrays and maps that contain what follows.
NESTED_OPENINGS = [
    b"\x91",
    b"\x81\xa1a",
    b"\x81\xa5other",
    b"\x81\x91",
    b"\xdd\x00\x00\x00\x01",
    b"\x92\xc0",
    b"\x81\xa8contacts\x91",
]
ARRAY_ENTRIES = (b"\xcb" + bytes(8), b"\xa1a", b"\xc3", b"\x90", b"\x80", b"\x00")
UNKNOWN_FIELD = "other"
USUAL_ENTRY_COUNTS = (2_000, 20_000)
USUAL_DEPTHS = (10, 100, 1_000, 5_000)
# Of a payload that is as large as payloads may be, or larger.
MAX_SIZE_PROBABILITY = 1 / 500
MAX_RANDOM_BYTES = 200
MAX_SPLICED_BYTES = 60
MAX_REMOVED_BYTES = 10
KEPT_FIELD_PROBABILITY = 0.8
WRONG_ENCODING_PROBABILITY = 0.02


@dataclass(frozen=True)
class SeedMessage:
    """A valid message that payloads are made from."""

    message: type[Message]
    plain: dict[str, Any]  # its fields as plain values
    payload: bytes
    places: list[tuple[Place, inspect.Type]]  # where a value can be replaced, and the type there


@dataclass(frozen=True)
class FuzzSample:
    """A payload and its encoding for the decoder of one message."""

    message: type[Message]
    mutation: str  # what was done to a valid payload
    payload: bytes
    encoding: str


def make_seed_messages() -> list[SeedMessage]:
    """Make at least one valid message of every type that may be a payload of its own."""
    seeds: list[SeedMessage] = []
    for message in VERSIONS:
        plain = make_plain_example(message)
        places = list(iter_places(plain, inspect.type_info(message)))
        seeds.append(SeedMessage(message, plain, encode(plain), places))
        for realistic in REALISTIC_MESSAGES.get(message, []):
            fields = {name: getattr(realistic, name) for name in realistic.__struct_fields__}
            seeds.append(make_seed_of_fields(message, fields, encode(realistic)))
    return seeds


def make_seed_of_fields(
    message: type[Message], fields: dict[str, Any], payload: bytes
) -> SeedMessage:
    """Make a seed in which only whole fields can be replaced, by values of any type."""
    places: list[tuple[Place, inspect.Type]] = [((name,), inspect.AnyType()) for name in fields]
    return SeedMessage(message, fields, payload, places)


class SampleMaker:
    """Makes one sample after the other. The same random numbers give the same samples."""

    def __init__(self, rng: random.Random, seeds: Sequence[SeedMessage] | None = None) -> None:
        """Create the maker.

        Args:
            rng: The random numbers.
            seeds: Valid messages that samples are made from; None for those of `make_seed_messages`.
        """
        self._rng = rng
        self._seeds = list(seeds or make_seed_messages())
        self._mutations: dict[str, Callable[[SeedMessage], bytes]] = {
            "valid": lambda seed: seed.payload,
            "random": lambda _seed: rng.randbytes(rng.randrange(MAX_RANDOM_BYTES)),
            "truncated": lambda seed: seed.payload[: rng.randrange(len(seed.payload))],
            "bit-flipped": lambda seed: flip_bits(rng, seed.payload),
            "spliced": self._splice,
            "type-confused": self._replace_value,
            "fields lost": self._remove_fields,
            "huge length": self._insert_huge_length,
            "huge": self._make_field_huge,
            "nested": self._nest,
            "other message": lambda _seed: rng.choice(self._seeds).payload,
        }

    def make_sample(self) -> FuzzSample:
        """Make the next sample."""
        rng = self._rng
        seed = rng.choice(self._seeds)
        mutation = rng.choice(list(self._mutations))
        encoding = format_encoding(seed.message)
        if rng.random() < WRONG_ENCODING_PROBABILITY:
            encoding = self._make_wrong_encoding(encoding)
        return FuzzSample(seed.message, mutation, self._mutations[mutation](seed), encoding)

    def _make_wrong_encoding(self, encoding: str) -> str:
        position = self._rng.randrange(len(encoding))
        random_character = chr(self._rng.randrange(1, 0xD800))
        wrong_encodings = [
            encoding[:position],
            encoding + "0",
            encoding[:position] + random_character,
            "",
        ]
        return self._rng.choice(wrong_encodings)

    def _splice(self, seed: SeedMessage) -> bytes:
        """Replace a piece by one of another payload."""
        payload = seed.payload
        other = self._rng.choice(self._seeds).payload
        position = self._rng.randrange(len(payload))
        other_begin = self._rng.randrange(len(other))
        other_end = other_begin + self._rng.randrange(MAX_SPLICED_BYTES)
        rest = payload[position + self._rng.randrange(MAX_REMOVED_BYTES) :]
        return payload[:position] + other[other_begin:other_end] + rest

    def _replace_value(self, seed: SeedMessage) -> bytes:
        """Replace a value by one that its type forbids, or by an unusual one."""
        place, value_type = self._rng.choice(seed.places)
        invalid_values = list_invalid_values(value_type)
        if invalid_values and self._rng.random() < 0.5:
            value = self._rng.choice(invalid_values)
        else:
            value = self._rng.choice(UNUSUAL_VALUES)
        return encode(replace_at(seed.plain, place, value))

    def _remove_fields(self, seed: SeedMessage) -> bytes:
        kept = {
            name: value
            for name, value in seed.plain.items()
            if self._rng.random() < KEPT_FIELD_PROBABILITY
        }
        return encode(kept)

    def _insert_huge_length(self, seed: SeedMessage) -> bytes:
        """Insert the beginning of a value that states more content than follows."""
        position = self._rng.randrange(len(seed.payload))
        length = self._rng.choice(HUGE_LENGTHS)
        beginning = self._rng.choice(SIZED_TYPE_CODES) + length
        return seed.payload[:position] + beginning + seed.payload[position:]

    def _make_field_huge(self, seed: SeedMessage) -> bytes:
        """Replace or add a field that is an array of very many entries."""
        count = self._rng.choice(USUAL_ENTRY_COUNTS)
        if self._rng.random() < MAX_SIZE_PROBABILITY:
            count = self._rng.choice((MAX_PAYLOAD_BYTES // 9, MAX_PAYLOAD_BYTES))
        entry = self._rng.choice(ARRAY_ENTRIES)
        array = ARRAY_32_CODE + count.to_bytes(4, "big") + entry * count
        huge_field = self._rng.choice([UNKNOWN_FIELD, *seed.plain])
        others = {name: value for name, value in seed.plain.items() if name != huge_field}
        entry_count = min(len(others) + 1, MAX_SHORT_MAP_ENTRIES)
        map_code = bytes([SHORT_MAP_CODE + entry_count])
        # The first byte of the encoded map is its own code, which `map_code` replaces.
        return map_code + encode(huge_field) + array + encode(others)[1:]

    def _nest(self, seed: SeedMessage) -> bytes:
        """Nest arrays or maps deeply, as a payload of their own or in a field."""
        depth = self._rng.choice(USUAL_DEPTHS)
        if self._rng.random() < MAX_SIZE_PROBABILITY:
            depth = MAX_PAYLOAD_BYTES // 9
        nested = self._rng.choice(NESTED_OPENINGS) * depth + NIL
        if self._rng.random() < 0.5:
            return nested
        field_name = self._rng.choice([UNKNOWN_FIELD, *seed.plain])
        map_of_two = bytes([SHORT_MAP_CODE + 2])
        return map_of_two + encode(field_name) + nested + seed.payload[1:]
