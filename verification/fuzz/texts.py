"""Bytes that nobody should write: files and datagrams that are right but for one thing, or wrong all over.

Works on any bytes; what it knows of is JSON and TOML: numbers, words, brackets, lines, dotted keys.
"""

import random
import re
from collections.abc import Callable, Sequence

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb'"[^"\n]*"')
NUMBERS = [
    b"NaN",
    b"nan",
    b"inf",
    b"-Infinity",
    b"1e999",
    b"-1e308",
    b"5e-324",
    b"0",
    b"-1",
    b"9" * 400,
    b"9" * 5000,
]
NUMBERS += [
    b"4294967296",
    b"9223372036854775808",
    b"18446744073709551616",
    b"1.5",
    b"0x7F",
    b"1_000",
    b"true",
    b'""',
]
WORDS = [
    b'""',
    b'"\\u0000"',
    b'"\x1b[2J\x1b]0;x\x07"',
    b'"' + b"x" * 70_000 + b'"',
    b'"\\ud800"',
    b'"\xff\xfe"',
    b'"%s%n"',
]
WORDS += [
    b'"../../../../etc/passwd"',
    b'"/dev/zero"',
    b'"__class__"',
    b"null",
    b"[]",
    b"{}",
    b"7",
    b'"\xd0\xb6\xe2\x80\xae"',
]
OPENINGS = [b"[", b'{"a":', b"[[", b"a = [", b"[a.", b'{"a":[', b"x.", b"((", b"{a={"]
RARE = 200  # one in so many is as large as a megabyte
LARGE, LARGEST = 20_000, 1 << 20


def flipped(rng: random.Random, payload: bytes) -> bytes:
    """With some of its bits the other way."""
    changed = bytearray(payload)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


class TextMaker:
    """Makes one payload after the other; the same ones for the same random numbers."""

    def __init__(
        self, rng: random.Random, seeds: Sequence[bytes], max_bytes: int = LARGEST
    ) -> None:
        """seeds: valid ones; max_bytes: none is longer."""
        self._rng, self._seeds, self._most = rng, [seed for seed in seeds if seed], max_bytes
        self._kinds: dict[str, Callable[[bytes], bytes]] = {
            "valid": lambda seed: seed,
            "random": lambda seed: rng.randbytes(rng.randrange(300)),
            "truncated": lambda seed: seed[: rng.randrange(len(seed))],
            "bit-flipped": lambda seed: flipped(rng, seed),
            "spliced": self._spliced,
            "number": lambda seed: self._replaced(seed, NUMBER, NUMBERS),
            "word": lambda seed: self._replaced(seed, WORD, WORDS),
            "nested": self._nested,
            "repeated": self._repeated,
            "line lost": lambda seed: self._lines(
                seed, lambda lines, at: lines[:at] + lines[at + 1 :]
            ),
            "line twice": lambda seed: self._lines(
                seed, lambda lines, at: [*lines[: at + 1], *lines[at:]]
            ),
            "strange bytes": self._strange,
        }

    def make(self) -> tuple[str, bytes]:
        """What was done, and the payload."""
        kind = self._rng.choice(list(self._kinds))
        return kind, self._kinds[kind](self._rng.choice(self._seeds))[: self._most]

    def _at(self, seed: bytes) -> int:
        return self._rng.randrange(len(seed) + 1)

    def _spliced(self, seed: bytes) -> bytes:
        other, at = self._rng.choice(self._seeds), self._at(seed)
        since = self._at(other)
        return (
            seed[:at]
            + other[since : since + self._rng.randrange(200)]
            + seed[at + self._rng.randrange(20) :]
        )

    def _replaced(self, seed: bytes, what: re.Pattern[bytes], by: Sequence[bytes]) -> bytes:
        found = list(what.finditer(seed))
        if not found:
            return seed + self._rng.choice(by)
        place = self._rng.choice(found)
        return seed[: place.start()] + self._rng.choice(by) + seed[place.end() :]

    def _size(self) -> int:
        return (
            LARGEST if self._rng.random() < 1 / RARE else self._rng.choice((10, 1000, 3000, LARGE))
        )

    def _nested(self, seed: bytes) -> bytes:
        opening = self._rng.choice(OPENINGS)
        at = self._rng.choice((0, self._at(seed), seed.find(b":") + 1, seed.find(b"=") + 1))
        return (
            seed[:at] + opening * max(min(self._size(), self._most) // len(opening), 1) + seed[at:]
        )

    def _repeated(self, seed: bytes) -> bytes:
        at = self._at(seed)
        piece = seed[at : at + self._rng.randrange(1, 60)] or b" "
        return seed[:at] + piece * max(min(self._size(), self._most) // len(piece), 1) + seed[at:]

    def _lines(self, seed: bytes, change: Callable[[list[bytes], int], list[bytes]]) -> bytes:
        mark = b"\n" if b"\n" in seed else b","
        lines = seed.split(mark)
        return mark.join(change(lines, self._rng.randrange(len(lines))))

    def _strange(self, seed: bytes) -> bytes:
        at = self._at(seed)
        strange = self._rng.choice(
            (
                b"\x00",
                b"\xff\xfe",
                b"\xed\xa0\x80",
                b"\x1b[31m",
                b"\xef\xbb\xbf",
                b"\xc2\x85",
                b"\r",
            )
        )
        return seed[:at] + strange + seed[at:]
