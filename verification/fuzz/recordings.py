"""Damaged and forged copies of a real recording, into every command that reads one.

A command may do its work, do it and say what is lost, or refuse in a line; within the limits of `forked`. Nothing else.
"""

import random
import shutil
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from snakesim_operator.recording.chunks import RECORD_HEADER, unpack_chunk
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.operator.damaged_recordings import (
    RecordSpan,
    chunks,
    flipped,
    packed,
    recorded,
    spans,
)
from verification.fuzz.forked import Forked, forked

SPOILT, WHOLE, OUT = "spoilt.mcap", "whole.mcap", "made"
FORMATS = ("csv", "npz", "mcap", "parquet", "lerobot")
COMMANDS: dict[str, list[str]] = {
    "info": ["recording", "info", SPOILT],
    "info --json": ["recording", "info", SPOILT, "--json"],
    "report": ["recording", "report", SPOILT],
    "compare with it": ["study", "compare", WHOLE, SPOILT],
    "compare it": ["study", "compare", SPOILT, WHOLE, "--json"],
    **{
        f"export {form}": ["recording", "export", SPOILT, "--format", form, "--out", OUT]
        for form in FORMATS
    },
    "replay": ["replay", SPOILT, "--speed", "1000000"],
    "replay --control": ["replay", SPOILT, "--control"],
    "video": [
        "recording",
        "video",
        SPOILT,
        "--out",
        "film.gif",
        "--width",
        "32",
        "--height",
        "32",
        "--fps",
        "5",
    ],
    "console": ["console", SPOILT, "--port", "0"],
}
TRUTH = "export mcap"  # reads every message: when it says that something is lost, no other may say nothing
ABSURD = (0, 1, 2**16, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
LINES = 4  # of a refusal, at most
DAMAGED, REFUSED = 3, 2

Damage = Callable[[random.Random, bytes], bytes]


def flips(chance: random.Random, content: bytes) -> bytes:
    """Some bits, anywhere."""
    for _ in range(chance.choice((1, 1, 3, 20))):
        content = flipped(content, chance.randrange(8, len(content)))
    return content


def cut(chance: random.Random, content: bytes) -> bytes:
    """The end is missing."""
    return content[: chance.randrange(8, len(content))]


def hole(chance: random.Random, content: bytes) -> bytes:
    """A part is missing, or is zeros."""
    begin = chance.randrange(8, len(content))
    end = min(begin + chance.choice((1, 100, 50_000)), len(content))
    return content[:begin] + bytes(end - begin) * chance.randrange(2) + content[end:]


def swapped(chance: random.Random, content: bytes) -> bytes:
    """Two chunks have changed places, or one is there twice."""
    a, b = sorted(chance.sample(chunks(content), 2), key=lambda span: span.begin)
    first, second = content[a.begin : a.end], content[b.begin : b.end]
    if chance.random() < 0.3:
        second = first
    return content[: a.begin] + second + content[a.end : b.begin] + first + content[b.end :]


def lying_head(chance: random.Random, content: bytes) -> bytes:
    """A length, size, checksum or kind is another one."""
    span = chance.choice([*spans(content), *chunks(content)])
    at, form = span.begin + 1, "<Q"
    if span.opcode == Opcode.CHUNK:
        at, form = chance.choice(
            ((span.begin + 1, "<Q"), *((span.begin + 9 + k, "<Q") for k in (0, 8, 16, 40)))
        )
    elif chance.random() < 0.2:
        at, form = span.begin, "<B"
    size = struct.calcsize(form)
    lie = chance.choice((*ABSURD, len(content), span.end - span.begin)) % 256**size
    return content[:at] + struct.pack(form, lie) + content[at + size :]


def foreign(chance: random.Random, content: bytes) -> bytes:
    """A record that nobody of ours writes: a bomb, a bad compression, an absurd length."""
    at = chance.choice(spans(content)).begin
    made = chance.choice(
        (
            packed(bytes(60_000_000)) * chance.choice((1, 30)),
            packed(b"abc", "lz4", b"no such thing"),
            packed(b"abc", "snappy"),
            packed(RECORD_HEADER.pack(Opcode.MESSAGE, 2**40)),
            RECORD_HEADER.pack(chance.randrange(256), chance.choice(ABSURD)) + bytes(40),
        )
    )
    return content[:at] + made + content[at:]


def forged(chance: random.Random, content: bytes) -> bytes:
    """A chunk that is whole, with messages that are not: other bytes, times, numbers and channels."""
    span: RecordSpan = chance.choice(chunks(content))
    data = unpack_chunk(content[span.begin + RECORD_HEADER.size : span.end])
    places = [
        one.begin + RECORD_HEADER.size
        for one in spans(data, magic=0)
        if one.opcode == Opcode.MESSAGE
    ]
    for at in chance.sample(places, min(len(places), chance.choice((1, 5, 50)))):
        what = chance.randrange(4)
        if what == 0:
            struct.pack_into("<H", data, at, chance.randrange(40))
        elif what == 1:
            struct.pack_into("<I", data, at + 2, chance.choice(ABSURD) % 2**32)
        elif what == 2:
            struct.pack_into("<Q", data, at + 6, chance.choice((*ABSURD, 10**9, 2**61)))
        else:
            length = RECORD_HEADER.unpack_from(data, at - RECORD_HEADER.size)[1]
            for _ in range(chance.choice((1, 8))):
                data[at + 22 + chance.randrange(max(length - 22, 1))] = chance.randrange(256)
    return content[: span.begin] + packed(bytes(data)) + content[span.end :]


def noise(chance: random.Random, content: bytes) -> bytes:
    """Nothing behind the magic that is of ours."""
    return MCAP0_MAGIC + chance.randbytes(chance.choice((0, 1, 500, 100_000)))


def untouched(_chance: random.Random, content: bytes) -> bytes:
    """Whole: no command may find a loss in it."""
    return content


DAMAGES: tuple[Damage, ...] = (
    flips,
    cut,
    hole,
    swapped,
    lying_head,
    foreign,
    forged,
    noise,
    untouched,
)


@dataclass
class RecordingsVerdict:
    """What became of all of them."""

    codes: dict[str, Counter[int]] = field(default_factory=dict[str, Counter[int]])  # by command
    violations: list[str] = field(default_factory=list[str])
    longest_cpu_s: float = 0.0
    peak_mb: float = 0.0


def fuzz(
    folder: Path, copies: int, seed: int, command_count: int | None = None
) -> RecordingsVerdict:
    """So many damaged copies, each into all commands, or so many of them in turn."""
    recorded(folder / "run", 0.6, 40_000)
    content, verdict = (folder / "run" / RECORDING_FILENAME).read_bytes(), RecordingsVerdict()
    names = [name for name in COMMANDS if name != TRUTH]
    with forked(folder) as snakesim:
        for number in range(copies):
            damage, chance = DAMAGES[number % len(DAMAGES)], random.Random(seed * 100_000 + number)
            spoilt = damage(chance, content)
            first = number * (command_count or 0) % len(names)
            chosen = (
                names if command_count is None else [*names, *names][first : first + command_count]
            )
            _try(
                folder / f"{number}",
                snakesim,
                spoilt,
                content,
                chosen,
                f"{damage.__name__} {number}",
                verdict,
            )
    return verdict


def _try(
    folder: Path,
    snakesim: Forked,
    spoilt: bytes,
    content: bytes,
    names: Sequence[str],
    what: str,
    verdict: RecordingsVerdict,
) -> None:
    incomplete = False
    for name in (TRUTH, *names):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / SPOILT).write_bytes(spoilt)
        (folder / WHOLE).write_bytes(content)
        more = ["--endpoint", find_free_endpoint()] if name == "replay" else []
        outcome = snakesim(folder, *COMMANDS[name], *more)
        verdict.codes.setdefault(name, Counter())[outcome.code] += 1
        verdict.longest_cpu_s = max(verdict.longest_cpu_s, outcome.cpu_s)
        verdict.peak_mb = max(verdict.peak_mb, outcome.peak_mb)
        incomplete |= name == TRUTH and outcome.code == DAMAGED
        wrong = (
            outcome.code not in (0, 1, REFUSED, DAMAGED) or "Traceback" in outcome.out + outcome.err
        )
        wrong |= incomplete and outcome.code == 0
        wrong |= outcome.code == DAMAGED and "incomplete: " not in outcome.err
        wrong |= outcome.code == REFUSED and not 0 < len(outcome.err.splitlines()) <= LINES
        if wrong:
            verdict.violations.append(f"{what}, {name}: code {outcome.code}: {outcome.err[-1500:]}")
    shutil.rmtree(folder)


def table(verdict: RecordingsVerdict) -> str:
    """For people."""
    lines = [
        f"{name:<18}" + ", ".join(f"{count} with {code}" for code, count in sorted(codes.items()))
        for name, codes in verdict.codes.items()
    ]
    lines.append(f"at most {verdict.longest_cpu_s:.1f} s of CPU time, and {verdict.peak_mb:.0f} MB")
    return "\n".join([*lines, *verdict.violations])
