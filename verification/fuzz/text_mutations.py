"""Makes invalid files and datagrams: valid ones with one thing wrong, or with everything wrong.

Works on any bytes. It knows some syntax of JSON and TOML: numbers, strings, brackets, lines, dotted keys.
"""

import random
import re
from collections.abc import Callable, Sequence

NUMBER_PATTERN = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
STRING_PATTERN = re.compile(rb'"[^"\n]*"')
WRONG_NUMBERS = [
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
    b"4294967296",
    b"9223372036854775808",
    b"18446744073709551616",
    b"1.5",
    b"0x7F",
    b"1_000",
    b"true",
    b'""',
]
WRONG_STRINGS = [
    b'""',
    b'"\\u0000"',
    b'"\x1b[2J\x1b]0;x\x07"',
    b'"' + b"x" * 70_000 + b'"',
    b'"\\ud800"',
    b'"\xff\xfe"',
    b'"%s%n"',
    b'"../../../../etc/passwd"',
    b'"/dev/zero"',
    b'"__class__"',
    b"null",
    b"[]",
    b"{}",
    b"7",
    b'"\xd0\xb6\xe2\x80\xae"',
]
NESTED_OPENINGS = [b"[", b'{"a":', b"[[", b"a = [", b"[a.", b'{"a":[', b"x.", b"((", b"{a={"]
UNUSUAL_BYTES = (
    b"\x00",
    b"\xff\xfe",
    b"\xed\xa0\x80",
    b"\x1b[31m",
    b"\xef\xbb\xbf",
    b"\xc2\x85",
    b"\r",
)
USUAL_SIZES_BYTES = (10, 1000, 3000, 20_000)  # of a nested or repeated piece
MAX_TEXT_BYTES = 1 << 20
HUGE_PROBABILITY = 1 / 200  # of a nested or repeated piece of MAX_TEXT_BYTES
MAX_RANDOM_BYTES = 300
MAX_SPLICED_BYTES = 200
MAX_REMOVED_BYTES = 20
MAX_REPEATED_BYTES = 60


def flip_bits(rng: random.Random, payload: bytes) -> bytes:
    """Flip one to eight bits of a payload that is not empty."""
    changed = bytearray(payload)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


class TextMaker:
    """Makes one payload after the other. The same random numbers give the same payloads."""

    def __init__(
        self, rng: random.Random, valid_texts: Sequence[bytes], max_bytes: int = MAX_TEXT_BYTES
    ) -> None:
        """Create the maker.

        Args:
            rng: The random numbers.
            valid_texts: The texts that the payloads are made from. Empty ones are ignored.
            max_bytes: The length at which payloads are cut.
        """
        self._rng = rng
        self._valid_texts = [text for text in valid_texts if text]
        self._max_bytes = max_bytes
        self._mutations: dict[str, Callable[[bytes], bytes]] = {
            "valid": lambda text: text,
            "random": lambda _text: rng.randbytes(rng.randrange(MAX_RANDOM_BYTES)),
            "truncated": lambda text: text[: rng.randrange(len(text))],
            "bit-flipped": lambda text: flip_bits(rng, text),
            "spliced": self._splice,
            "number": lambda text: self._replace_match(text, NUMBER_PATTERN, WRONG_NUMBERS),
            "word": lambda text: self._replace_match(text, STRING_PATTERN, WRONG_STRINGS),
            "nested": self._nest,
            "repeated": self._repeat,
            "line lost": self._remove_line,
            "line twice": self._repeat_line,
            "strange bytes": self._insert_unusual_bytes,
        }

    def make_payload(self) -> tuple[str, bytes]:
        """Make the next payload, and return the name of its mutation with it."""
        mutation = self._rng.choice(list(self._mutations))
        payload = self._mutations[mutation](self._rng.choice(self._valid_texts))
        return mutation, payload[: self._max_bytes]

    def _choose_position(self, text: bytes) -> int:
        return self._rng.randrange(len(text) + 1)

    def _splice(self, text: bytes) -> bytes:
        """Replace a piece by one of another text."""
        other = self._rng.choice(self._valid_texts)
        position = self._choose_position(text)
        other_begin = self._choose_position(other)
        other_end = other_begin + self._rng.randrange(MAX_SPLICED_BYTES)
        rest = text[position + self._rng.randrange(MAX_REMOVED_BYTES) :]
        return text[:position] + other[other_begin:other_end] + rest

    def _replace_match(
        self, text: bytes, pattern: re.Pattern[bytes], replacements: Sequence[bytes]
    ) -> bytes:
        """Replace one match of a pattern, or append the replacement if there is no match."""
        matches = list(pattern.finditer(text))
        if not matches:
            return text + self._rng.choice(replacements)
        match = self._rng.choice(matches)
        return text[: match.start()] + self._rng.choice(replacements) + text[match.end() :]

    def _nest(self, text: bytes) -> bytes:
        """Insert many openings of brackets that are not closed."""
        opening = self._rng.choice(NESTED_OPENINGS)
        positions = (0, self._choose_position(text), text.find(b":") + 1, text.find(b"=") + 1)
        position = self._rng.choice(positions)
        return text[:position] + self._multiply(opening) + text[position:]

    def _repeat(self, text: bytes) -> bytes:
        """Repeat a piece of the text many times."""
        position = self._choose_position(text)
        piece = text[position : position + self._rng.randrange(1, MAX_REPEATED_BYTES)] or b" "
        return text[:position] + self._multiply(piece) + text[position:]

    def _multiply(self, piece: bytes) -> bytes:
        """Repeat a piece up to a random size."""
        size_bytes = MAX_TEXT_BYTES
        if self._rng.random() >= HUGE_PROBABILITY:
            size_bytes = self._rng.choice(USUAL_SIZES_BYTES)
        return piece * max(min(size_bytes, self._max_bytes) // len(piece), 1)

    def _remove_line(self, text: bytes) -> bytes:
        separator, lines = _split_lines(text)
        del lines[self._rng.randrange(len(lines))]
        return separator.join(lines)

    def _repeat_line(self, text: bytes) -> bytes:
        separator, lines = _split_lines(text)
        index = self._rng.randrange(len(lines))
        lines.insert(index, lines[index])
        return separator.join(lines)

    def _insert_unusual_bytes(self, text: bytes) -> bytes:
        position = self._choose_position(text)
        return text[:position] + self._rng.choice(UNUSUAL_BYTES) + text[position:]


def _split_lines(text: bytes) -> tuple[bytes, list[bytes]]:
    """Split a text at its line ends, or at its commas if it is one line. Returns the separator and the parts."""
    separator = b"\n" if b"\n" in text else b","
    return separator, text.split(separator)
