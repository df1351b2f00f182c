"""Decides about the messages of one key under injected faults: which are sent now or later, and with which bytes.

Pure: it gets payloads, the time and a seed, and returns payloads to send. Each message is corrupted, dropped,
duplicated, reordered and delayed, in this order; a flood repeats the newest. Delayed messages keep their order.
"""

import random
import struct
from collections import deque
from math import inf

from snakesim_hal.model.fault_kinds import FaultInjection

MAX_REPEATS_PER_CALL = 256  # of a flood; after a delay of this process, more repeats are skipped
MAX_BURST_BYTES = 64  # inserted, or copied from elsewhere in the message
FLOAT64_TYPE_BYTE = 0xCB  # of MessagePack
FLOAT64_BYTES = 8
SPECIAL_DOUBLES = (float("nan"), inf, -inf, 1e308, -1e308, 5e-324, -0.0)


class MessageDisturbance:
    """The faults of one key. Times are of one clock, in seconds. Not thread-safe; the caller holds a lock."""

    def __init__(self, seed: str) -> None:
        """Create a disturbance without active faults, whose random numbers follow from a seed."""
        self._rng = random.Random(seed)
        self._amount_by_kind: dict[str, float] = {}  # amounts of the active faults
        # Sent after the next message; None without reordering.
        self._held_back_payload: bytes | None = None
        # Time at which to send it, payload.
        self._delayed_payloads: deque[tuple[float, bytes]] = deque()
        self._newest_payload: bytes | None = None  # the writer's last message
        self._next_repeat_time_s = inf  # time of the next repeat of a flood

    def start_fault(self, injection: FaultInjection, now_s: float) -> None:
        """Start a fault. If a fault of its kind is active already, the new amount replaces the old one."""
        assert injection.amount is not None, f"{injection} was not checked"
        self._amount_by_kind[injection.kind] = injection.amount
        if injection.kind == "flood":
            self._next_repeat_time_s = now_s

    def end_fault(self, kind: str, now_s: float) -> list[bytes]:
        """End a fault.

        Args:
            kind: Kind of the fault, such as "delay".
            now_s: Current time.

        Returns:
            Payloads to send now. Delayed payloads still become due later.
        """
        self._amount_by_kind.pop(kind, None)
        if kind == "flood":
            self._next_repeat_time_s = inf
        if kind == "reorder" and self._held_back_payload is not None:
            payload = self._held_back_payload
            self._held_back_payload = None
            return self._delay_payloads([payload], now_s)
        return []

    @property
    def is_over(self) -> bool:
        """Return whether no fault is active and no payload is delayed."""
        return not self._amount_by_kind and not self._delayed_payloads

    def disturb_payload(self, payload: bytes, now_s: float) -> list[bytes]:
        """Apply the active faults to a message of the writer, and return the payloads to send now."""
        if self._newest_payload is None:
            self._next_repeat_time_s = max(self._next_repeat_time_s, now_s)
        self._newest_payload = payload
        return self._apply_faults(payload, now_s)

    def pop_due_payloads(self, now_s: float) -> list[bytes]:
        """Return the delayed and repeated payloads that are due."""
        payloads: list[bytes] = []
        while self._delayed_payloads and self._delayed_payloads[0][0] <= now_s:
            _, payload = self._delayed_payloads.popleft()
            payloads.append(payload)
        if self._newest_payload is not None:
            for _ in range(self._count_repeats(now_s)):
                payloads += self._apply_faults(self._newest_payload, now_s)
        return payloads

    def _count_repeats(self, now_s: float) -> int:
        """Return how often a flood repeats the newest message now, and schedule its next repeat."""
        if self._next_repeat_time_s > now_s:
            return 0
        interval_s = 1.0 / self._amount_by_kind["flood"]
        repeats = min(
            int((now_s - self._next_repeat_time_s) / interval_s) + 1, MAX_REPEATS_PER_CALL
        )
        self._next_repeat_time_s += repeats * interval_s
        if self._next_repeat_time_s <= now_s:
            self._next_repeat_time_s = now_s + interval_s
        return repeats

    def next_due_s(self) -> float:
        """Return the time at which the next delayed or repeated payload is due; inf if there is none."""
        next_delayed_s = self._delayed_payloads[0][0] if self._delayed_payloads else inf
        if self._newest_payload is None:
            return next_delayed_s
        return min(next_delayed_s, self._next_repeat_time_s)

    def _apply_faults(self, payload: bytes, now_s: float) -> list[bytes]:
        """Return the payloads to send now instead of a payload; some may be queued until later."""
        # The order of the random draws must stay, so that the same seed gives the same faults.
        if self._draw_whether_applies("corrupt"):
            payload = corrupt_payload(payload, self._rng)
        if self._draw_whether_applies("drop"):
            return []
        payloads = [payload]
        if self._draw_whether_applies("duplicate"):
            payloads.append(payload)
        if self._held_back_payload is not None:
            payloads.append(self._held_back_payload)
            self._held_back_payload = None
        elif self._draw_whether_applies("reorder"):
            self._held_back_payload = payloads.pop()
        return self._delay_payloads(payloads, now_s)

    def _draw_whether_applies(self, kind: str) -> bool:
        """Draw whether a kind of fault applies to this message. The amount of the fault is the probability."""
        probability = self._amount_by_kind.get(kind, 0.0)
        return probability > 0.0 and self._rng.random() < probability

    def _delay_payloads(self, payloads: list[bytes], now_s: float) -> list[bytes]:
        """Queue payloads behind the delayed ones, which keeps the order. Without a delay, return them instead."""
        delay_s = self._amount_by_kind.get("delay", 0.0)
        if not delay_s and not self._delayed_payloads:
            return payloads
        last_due_s = self._delayed_payloads[-1][0] if self._delayed_payloads else 0.0
        due_s = max(now_s + delay_s, last_due_s)
        self._delayed_payloads.extend((due_s, payload) for payload in payloads)
        return []


def corrupt_payload(payload: bytes, rng: random.Random) -> bytes:
    """Return a corrupted copy of a payload, which always differs from the payload.

    One of these changes is drawn: bits are flipped, a byte is replaced, the end is cut off, bytes are inserted or
    copied, a number becomes NaN or another special value, or everything becomes noise.

    Args:
        payload: Encoded message.
        rng: Random generator. It decides the kind and the place of the change.
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
            start = rng.choice(positions) + 1  # after the type byte
            data[start : start + FLOAT64_BYTES] = struct.pack(">d", rng.choice(SPECIAL_DOUBLES))
        case _:  # also if a case before does not apply, as to an empty payload
            data = bytearray(rng.randbytes(rng.randint(0, 2 * len(data) + 1)))
    if data == payload:
        return payload + rng.randbytes(1)
    return bytes(data)


def _flip_bits(data: bytearray, rng: random.Random) -> None:
    """Flip 1 to 8 random bits."""
    for _ in range(rng.randint(1, 8)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _copy_burst(data: bytearray, rng: random.Random) -> None:
    """Replace some bytes by a copy of bytes from elsewhere in the data."""
    target = rng.randint(0, len(data))
    source = rng.randint(0, len(data))
    copied = data[source : source + rng.randint(1, MAX_BURST_BYTES)]
    data[target : target + rng.randint(0, MAX_BURST_BYTES)] = copied


def _find_doubles(data: bytearray) -> list[int]:
    """Return the positions of all bytes at which a MessagePack float64 may start."""
    return [i for i, byte in enumerate(data[:-FLOAT64_BYTES]) if byte == FLOAT64_TYPE_BYTE]
