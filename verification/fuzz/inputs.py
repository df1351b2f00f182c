"""Feeds invalid payloads to all decoders that do not decode wire messages: of datagrams, of files, of options.

Each input has valid payloads to start from, and a function that decodes a payload as the product does. A decoder may
raise ConfigError with a short reason. Any other exception ends the run.
"""

import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from snakesim_hal.base.errors import ConfigError
from verification.fuzz.text_mutations import MAX_TEXT_BYTES, TextMaker

MAX_DURATION_S = 10.0  # of one payload, on a machine that does something else as well
MAX_REASON_CHARACTERS = 1500  # of a refusal, whatever it quotes
MAX_QUOTED_BYTES = 300  # of a payload in an error
MAX_INPUTS = 1000  # more than there are, so that no two seeds share a payload


@dataclass(frozen=True)
class DecoderInput:
    """One decoder, as the product uses it."""

    name: str
    valid_payloads: list[bytes]
    decode: Callable[[bytes], str]  # returns in a word or two what became of a payload
    max_bytes: int = MAX_TEXT_BYTES


@dataclass
class InputReport:
    """How many payloads of one input had which result, and how long the slowest took."""

    outcomes: Counter[str] = field(default_factory=Counter[str])
    max_duration_s: float = 0.0


def fuzz_inputs(
    inputs: Sequence[DecoderInput], payload_count: int, seed: int
) -> dict[str, InputReport]:
    """Feed invalid payloads to each input.

    Args:
        inputs: The inputs.
        payload_count: The number of payloads for each input.
        seed: Selects the payloads.

    Returns:
        A report for each name of an input.

    Raises:
        Exception: A decoder has raised what it must not, or a check has failed.
    """
    reports: dict[str, InputReport] = {}
    for number, decoder_input in enumerate(inputs):
        rng = random.Random(seed * MAX_INPUTS + number)
        maker = TextMaker(rng, decoder_input.valid_payloads, decoder_input.max_bytes)
        report = InputReport()
        reports[decoder_input.name] = report
        for _ in range(payload_count):
            mutation, payload = maker.make_payload()
            _decode_payload(decoder_input, mutation, payload, report)
    return reports


def _decode_payload(
    decoder_input: DecoderInput, mutation: str, payload: bytes, report: InputReport
) -> None:
    """Decode one payload, and count the result."""
    description = (
        f"{decoder_input.name}, {mutation}, {len(payload)} bytes: {payload[:MAX_QUOTED_BYTES]!r}"
    )
    start_s = time.monotonic()
    try:
        outcome = decoder_input.decode(payload)
    except ConfigError as error:
        outcome = "refused"
        assert len(str(error)) <= MAX_REASON_CHARACTERS, f"{description}: a long reason"
    except Exception as error:
        error.add_note(description)
        raise
    duration_s = time.monotonic() - start_s
    report.outcomes[outcome] += 1
    report.max_duration_s = max(report.max_duration_s, duration_s)
    assert duration_s < MAX_DURATION_S, f"{description}: {duration_s:.1f} s"
