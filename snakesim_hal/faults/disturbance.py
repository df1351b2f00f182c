"""Injected faults of the messages of one key: which are sent now, which later, and with which bytes.

Pure: payloads, the time and a seed in; payloads to send out. In this order messages are corrupted, dropped,
duplicated, reordered, delayed; a flood repeats the newest. Delayed messages keep their order.
"""

import random
import struct
from collections import deque
from math import inf

from snakesim_hal.model.fault_kinds import Injection

MAX_AT_ONCE = 256  # repeats of a flood at once: after a delay of this process the others are skipped
LONGEST_BURST = 64  # bytes that are inserted, or copied from elsewhere in the message
DOUBLE = 0xCB  # MessagePack's mark of a float64
NASTY_DOUBLES = (float("nan"), inf, -inf, 1e308, -1e308, 5e-324, -0.0)


class Disturbance:
    """One key's faults. Times are of one clock, in seconds."""

    def __init__(self, seed: str) -> None:
        self._random = random.Random(seed)
        self._on: dict[str, float] = {}  # kind -> amount
        self._held: bytes | None = None  # held back until the next message has overtaken it
        self._late: deque[tuple[float, bytes]] = deque()
        self._newest: bytes | None = None
        self._repeat_s = inf  # time of the next repeat of a flood

    def begin(self, injection: Injection, now_s: float) -> None:
        """Begin a fault; for an active kind, the new amount replaces the old."""
        assert injection.amount is not None, f"{injection} was not checked"
        self._on[injection.kind] = injection.amount
        if injection.kind == "flood":
            self._repeat_s = now_s

    def end(self, kind: str, now_s: float) -> list[bytes]:
        """End a fault. Returns payloads to send now; delayed ones still come later."""
        self._on.pop(kind, None)
        if kind == "flood":
            self._repeat_s = inf
        if kind == "reorder" and self._held is not None:
            held, self._held = self._held, None
            return self._delayed([held], now_s)
        return []

    @property
    def over(self) -> bool:
        """Whether no fault is active, and nothing is pending."""
        return not self._on and not self._late

    def put(self, payload: bytes, now_s: float) -> list[bytes]:
        """Take a message of the writer. Returns payloads to send now."""
        if self._newest is None:
            self._repeat_s = max(self._repeat_s, now_s)
        self._newest = payload
        return self._passed(payload, now_s)

    def due(self, now_s: float) -> list[bytes]:
        """Delayed or repeated payloads that are due."""
        out: list[bytes] = []
        while self._late and self._late[0][0] <= now_s:
            out.append(self._late.popleft()[1])
        if self._repeat_s <= now_s and self._newest is not None:
            every_s = 1.0 / self._on["flood"]
            repeats = min(int((now_s - self._repeat_s) / every_s) + 1, MAX_AT_ONCE)
            self._repeat_s += repeats * every_s
            if self._repeat_s <= now_s:
                self._repeat_s = now_s + every_s
            for _ in range(repeats):
                out += self._passed(self._newest, now_s)
        return out

    def next_s(self) -> float:
        """When `due` has something; inf for never."""
        late_s = self._late[0][0] if self._late else inf
        return late_s if self._newest is None else min(late_s, self._repeat_s)

    def _passed(self, payload: bytes, now_s: float) -> list[bytes]:
        if self._happens("corrupt"):
            payload = corrupted(payload, self._random)
        if self._happens("drop"):
            return []
        out = [payload, payload] if self._happens("duplicate") else [payload]
        if self._held is not None:
            out.append(self._held)
            self._held = None
        elif self._happens("reorder"):
            self._held = out.pop()
        return self._delayed(out, now_s)

    def _happens(self, kind: str) -> bool:
        share = self._on.get(kind, 0.0)
        return share > 0.0 and self._random.random() < share

    def _delayed(self, payloads: list[bytes], now_s: float) -> list[bytes]:
        """Queue payloads behind the delayed ones, so that the order is kept."""
        delay_s = self._on.get("delay", 0.0)
        if not delay_s and not self._late:
            return payloads
        due_s = max(now_s + delay_s, self._late[-1][0] if self._late else 0.0)
        self._late.extend((due_s, payload) for payload in payloads)
        return []


def corrupted(payload: bytes, rng: random.Random) -> bytes:
    """A corrupted payload: bytes flipped, cut off, inserted or copied, a NaN, or pure noise."""
    data = bytearray(payload)
    match rng.randrange(7):
        case 0 if data:
            for _ in range(rng.randint(1, 8)):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 1 if data:
            data[rng.randrange(len(data))] = rng.randrange(256)
        case 2:
            del data[rng.randint(0, len(data)) :]
        case 3:
            at = rng.randint(0, len(data))
            data[at:at] = rng.randbytes(rng.randint(1, LONGEST_BURST))
        case 4:
            at, start = rng.randint(0, len(data)), rng.randint(0, len(data))
            data[at : at + rng.randint(0, LONGEST_BURST)] = data[start : start + rng.randint(1, LONGEST_BURST)]
        case 5 if places := [i for i, byte in enumerate(data[:-8]) if byte == DOUBLE]:
            at = rng.choice(places)
            data[at + 1 : at + 9] = struct.pack(">d", rng.choice(NASTY_DOUBLES))
        case _:
            data = bytearray(rng.randbytes(rng.randint(0, 2 * len(data) + 1)))
    if data == payload:
        return payload + rng.randbytes(1)
    return bytes(data)
