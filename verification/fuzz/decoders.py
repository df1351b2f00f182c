"""Feeds invalid payloads to the decoders of wire messages, and what they decode to a HAL without a network.

A decoder may decode a payload or raise WireError with a short reason. A HAL may do with a decoded message what its
command limiter and lifecycle allow. Any other exception ends the run.
"""

import os
import random
import resource
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import (
    VERSIONS,
    Answer,
    EstopRequest,
    JointCommand,
    JointState,
    LeaseRequest,
    LifecycleRequest,
    Message,
)
from snakesim_testing.hal.authority_rig import AuthorityRig, make_armed_rig
from snakesim_testing.hal.small_robots import PERIOD_NS
from verification.fuzz.payloads import FuzzSample, SampleMaker
from verification.fuzz.vitals import measure_process

MAX_REASON_CHARACTERS = 400  # of an error, whatever the sender wrote
PAYLOADS_PER_ROBOT = 1000  # until a new robot is armed
PAYLOADS_PER_TICK = 10
TIME_PER_TICK_NS = PERIOD_NS // 4  # short, so that the lease lasts for many payloads
MAX_TARGET_RAD = 5.0  # of a setpoint that the limiter may let through
MEMORY_MEASUREMENTS = 10  # of a whole run
ANSWER_DECODER = MessageDecoder(Answer)


@dataclass
class DecoderReport:
    """How many payloads had which result, and how much memory the process used."""

    # By mutation: "decoded", or the reason of the error.
    outcomes: dict[str, Counter[str]] = field(default_factory=dict[str, Counter[str]])
    reactions: Counter[str] = field(default_factory=Counter[str])  # of the HAL to decoded messages
    resident_mb: list[float] = field(default_factory=list[float])  # after each tenth of the run
    peak_mb: float = 0.0
    max_reason_characters: int = 0

    @property
    def growth_mb(self) -> float:
        """Memory gained since the first tenth of the run."""
        return self.resident_mb[-1] - self.resident_mb[0]


def fuzz_decoders(payload_count: int, seed: int) -> DecoderReport:
    """Decode invalid payloads, and pass on what decodes.

    Args:
        payload_count: The number of payloads.
        seed: Selects the payloads.

    Raises:
        Exception: A decoder or the HAL has raised what it must not, or a check has failed.
    """
    maker = SampleMaker(random.Random(seed))
    report = DecoderReport()
    decoders: dict[type[Message], MessageDecoder[Any]] = {
        message: MessageDecoder(message) for message in VERSIONS
    }
    hal = make_armed_rig()
    for number in range(payload_count):
        if number % PAYLOADS_PER_ROBOT == 0:
            hal = make_armed_rig()
        sample = maker.make_sample()
        _decode_and_pass_on(sample, decoders[sample.message], hal, report)
        if number % PAYLOADS_PER_TICK == 0:
            end_tick(hal)
        if (number + 1) % max(payload_count // MEMORY_MEASUREMENTS, 1) == 0:
            vitals = measure_process(os.getpid())
            assert vitals is not None
            report.resident_mb.append(vitals.resident_mb)
    report.peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return report


def _decode_and_pass_on(
    sample: FuzzSample, decoder: MessageDecoder[Any], hal: AuthorityRig, report: DecoderReport
) -> None:
    """Decode one payload, pass the message to the HAL, and count what happened."""
    outcomes = report.outcomes.setdefault(sample.mutation, Counter())
    try:
        message = decoder.decode(sample.payload, sample.encoding)
    except WireError as error:
        text = str(error)
        outcomes[error.reason] += 1
        report.max_reason_characters = max(report.max_reason_characters, len(text))
        assert len(text) <= MAX_REASON_CHARACTERS, (
            f"a reason of {len(text)} characters: {text[:200]}"
        )
        return
    assert type(message) is sample.message
    outcomes["decoded"] += 1
    report.reactions[f"{sample.message.__name__}: {pass_to_hal(hal, message)}"] += 1


def pass_to_hal(hal: AuthorityRig, message: Message) -> str:
    """Pass a message to a HAL without a network, and return in a word what the HAL did with it."""
    authority = hal.authority
    answer: Answer
    match message:
        case JointCommand():
            rejection = authority.process_command(
                message, now_ns=hal.now_ns, tick=hal.tick, age_ns=0
            )
            return rejection or "accepted"
        case JointState():
            authority.observe_joints(message, message.timestamp_ns)
            return "observed"
        case LeaseRequest():
            answer = authority.handle_lease_request(message, hal.now_ns)
        case LifecycleRequest():
            answer = authority.handle_lifecycle_request(message, hal.now_ns)
        case EstopRequest():
            answer = authority.handle_estop_request(message, hal.tick)
        case _:
            return "not for a HAL"
    assert ANSWER_DECODER.decode(encode(answer), format_encoding(Answer)) == answer
    return "yes" if answer.ok else "no"


def end_tick(hal: AuthorityRig) -> None:
    """Let the HAL end its tick, and check that its setpoints are within the limits."""
    hal.now_ns += TIME_PER_TICK_NS
    hal.tick += 1
    hal.authority.latch_faults_and_expire_lease(hal.now_ns, hal.tick)
    setpoints = hal.authority.compute_setpoints().setpoints
    assert all(abs(target) <= MAX_TARGET_RAD for target in setpoints.target)
