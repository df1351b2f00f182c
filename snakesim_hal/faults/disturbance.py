"""Decides about the messages of one key under injected faults: which are sent now or later, and with which bytes.

Pure: it gets payloads, the time and a seed, and returns payloads to send. Each message is corrupted, dropped,
duplicated, reordered and delayed, in this order; a flood repeats the newest. Delayed messages keep their order.
"""

import random
import struct
from collections import deque
from math import inf

from snakesim_hal.model.fault_kinds import Injection

MAX_AT_ONCE = 256  # repeats of a flood at once: after a delay of this process the others are skipped
MAX_BURST_BYTES = 64  # inserted, or copied from elsewhere in the message
FLOAT64_MARK = 0xCB  # of MessagePack
FLOAT64_BYTES = 8
NASTY_DOUBLES = (float("nan"), inf, -inf, 1e308, -1e308, 5e-324, -0.0)


class Disturbance:
    """The faults of one key. Times are of one clock, in seconds. Not thread-safe; the caller holds a lock."""

    def __init__(self, seed: str) -> None:
        """Draw all random numbers from a seed."""
        self._random = random.Random(seed)
        self._amounts: dict[str, float] = {}  # of active faults, by kind
        self._overtaken: bytes | None = None  # held back until the next message has been sent
        self._delayed: deque[tuple[float, bytes]] = deque()  # time at which to send it, payload
        self._newest: bytes | None = None  # the writer's last message
        self._repeat_s = inf  # time of the next repeat of a flood

    def begin(self, injection: Injection, now_s: float) -> None:
        """Begin a fault. If its kind is active already, the new amount replaces the old one."""
        assert injection.amount is not None, f"{injection} was not checked"
        self._amounts[injection.kind] = injection.amount
        if injection.kind == "flood":
            self._repeat_s = now_s

    def end(self, kind: str, now_s: float) -> list[bytes]:
        """End a fault.

        Returns:
            Payloads to send now. Delayed payloads still become due later.
        """
        self._amounts.pop(kind, None)
        if kind == "flood":
            self._repeat_s = inf
        if kind == "reorder" and self._overtaken is not None:
            overtaken = self._overtaken
            self._overtaken = None
            return self._delay([overtaken], now_s)
        return []

    @property
    def over(self) -> bool:
        """Return whether no fault is active and no payload is delayed."""
        return not self._amounts and not self._delayed

    def disturb(self, payload: bytes, now_s: float) -> list[bytes]:
        """Apply the active faults to a message of the writer, and return the payloads to send now."""
        if self._newest is None:
            self._repeat_s = max(self._repeat_s, now_s)
        self._newest = payload
        return self._apply_faults(payload, now_s)

    def due(self, now_s: float) -> list[bytes]:
        """Return the delayed and repeated payloads that are due."""
        payloads: list[bytes] = []
        while self._delayed and self._delayed[0][0] <= now_s:
            _, payload = self._delayed.popleft()
            payloads.append(payload)
        if self._newest is not None:
            for _ in range(self._count_repeats(now_s)):
                payloads += self._apply_faults(self._newest, now_s)
        return payloads

    def _count_repeats(self, now_s: float) -> int:
        """Return how often a flood repeats the newest message now, and set the time of its next repeat."""
        if self._repeat_s > now_s:
            return 0
        interval_s = 1.0 / self._amounts["flood"]
        repeats = min(int((now_s - self._repeat_s) / interval_s) + 1, MAX_AT_ONCE)
        self._repeat_s += repeats * interval_s
        if self._repeat_s <= now_s:
            self._repeat_s = now_s + interval_s
        return repeats

    def next_s(self) -> float:
        """Return the time at which `due` has a payload next; inf if never."""
        next_delayed_s = self._delayed[0][0] if self._delayed else inf
        if self._newest is None:
            return next_delayed_s
        return min(next_delayed_s, self._repeat_s)

    def _apply_faults(self, payload: bytes, now_s: float) -> list[bytes]:
        # The order of the draws is part of what a seed repeats.
        if self._happens("corrupt"):
            payload = corrupted(payload, self._random)
        if self._happens("drop"):
            return []
        payloads = [payload]
        if self._happens("duplicate"):
            payloads.append(payload)
        if self._overtaken is not None:
            payloads.append(self._overtaken)
            self._overtaken = None
        elif self._happens("reorder"):
            self._overtaken = payloads.pop()
        return self._delay(payloads, now_s)

    def _happens(self, kind: str) -> bool:
        """Draw whether a fault applies to this message; its amount is the probability."""
        probability = self._amounts.get(kind, 0.0)
        return probability > 0.0 and self._random.random() < probability

    def _delay(self, payloads: list[bytes], now_s: float) -> list[bytes]:
        """Queue payloads behind the delayed ones, so that their order stays. Returns those to send now."""
        delay_s = self._amounts.get("delay", 0.0)
        if not delay_s and not self._delayed:
            return payloads
        last_due_s = self._delayed[-1][0] if self._delayed else 0.0
        due_s = max(now_s + delay_s, last_due_s)
        self._delayed.extend((due_s, payload) for payload in payloads)
        return []


def corrupted(payload: bytes, rng: random.Random) -> bytes:
    """Return a corrupted copy of a payload, which always differs from it.

    Bits are flipped, a byte is replaced, the end is cut off, bytes are inserted or copied, a number becomes NaN or
    another nasty value, or everything becomes noise.
    """
    data = bytearray(payload)
    match rng.randrange(7):
        case 0 if data:
            _flip_bits(data, rng)
        case 1 if data:
            data[rng.randrange(len(data))] = rng.randrange(256)
        case 2:
            del data[rng.randint(0, len(data)) :]
        case 3:
            position = rng.randint(0, len(data))
            data[position:position] = rng.randbytes(rng.randint(1, MAX_BURST_BYTES))
        case 4:
            _copy_burst(data, rng)
        case 5 if positions := _find_doubles(data):
            begin = rng.choice(positions) + 1  # after the type byte of MessagePack
            data[begin : begin + FLOAT64_BYTES] = struct.pack(">d", rng.choice(NASTY_DOUBLES))
        case _:
            data = bytearray(rng.randbytes(rng.randint(0, 2 * len(data) + 1)))
    if data == payload:
        return payload + rng.randbytes(1)
    return bytes(data)


def _flip_bits(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randint(1, 8)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _copy_burst(data: bytearray, rng: random.Random) -> None:
    """Replace some bytes by a copy of others."""
    target = rng.randint(0, len(data))
    source = rng.randint(0, len(data))
    copied = data[source : source + rng.randint(1, MAX_BURST_BYTES)]
    data[target : target + rng.randint(0, MAX_BURST_BYTES)] = copied


def _find_doubles(data: bytearray) -> list[int]:
    """Return the positions of all bytes that may begin a MessagePack float64."""
    return [i for i, byte in enumerate(data[:-FLOAT64_BYTES]) if byte == FLOAT64_MARK]
