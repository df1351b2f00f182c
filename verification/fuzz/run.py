"""A run: decode sample after sample, let a HAL act on what decodes, and keep count."""

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
from verification.fuzz.payloads import SampleMaker
from verification.fuzz.vitals import vitals

LONGEST_REASON = 400  # characters of an error's text, whatever a sender wrote
PER_ROBOT = 1000  # payloads until a fresh robot is armed
PER_TICK = 10
ANSWERS = MessageDecoder(Answer)


@dataclass
class FuzzReport:
    """What became of the samples."""

    # By kind of mutation.
    outcomes: dict[str, Counter[str]] = field(default_factory=dict[str, Counter[str]])
    answers: Counter[str] = field(default_factory=Counter[str])  # what a HAL did with what decoded
    resident_mb: list[float] = field(default_factory=list[float])  # ten times in a run
    peak_mb: float = 0.0
    longest_reason: int = 0

    @property
    def growth_mb(self) -> float:
        """Memory gained since the first tenth of the run."""
        return self.resident_mb[-1] - self.resident_mb[0]


def taken(hal: AuthorityRig, message: Message) -> str:
    """What became of a message to a HAL without a network, in a word."""
    authority = hal.authority
    answer: Answer
    match message:
        case JointCommand():
            return (
                authority.process_command(message, now_ns=hal.now_ns, tick=hal.tick, age_ns=0)
                or "accepted"
            )
        case JointState():
            authority.observe_joints(message)
            return "observed"
        case LeaseRequest():
            answer = authority.handle_lease_request(message, hal.now_ns)
        case LifecycleRequest():
            answer = authority.handle_lifecycle_request(message, hal.now_ns)
        case EstopRequest():
            answer = authority.handle_estop_request(message, hal.tick)
        case _:
            return "not for a HAL"
    assert ANSWERS.decode(encode(answer), format_encoding(Answer)) == answer
    return "yes" if answer.ok else "no"


def pass_tick(hal: AuthorityRig) -> None:
    """The end of a tick."""
    hal.now_ns += PERIOD_NS // 4
    hal.tick += 1
    hal.authority.latch_faults_and_expire_lease(hal.now_ns, hal.tick)
    assert all(abs(target) <= 5.0 for target in hal.authority.compute_setpoints().setpoints.target)


def run(payload_count: int, seed: int) -> FuzzReport:
    """Raises whatever a decoder or the authority raises that it must not."""
    maker, report = SampleMaker(random.Random(seed)), FuzzReport()
    decoders: dict[type[Message], MessageDecoder[Any]] = {
        message: MessageDecoder(message) for message in VERSIONS
    }
    hal = make_armed_rig()
    for number in range(payload_count):
        if number % PER_ROBOT == 0:
            hal = make_armed_rig()
        sample = maker.make()
        outcomes = report.outcomes.setdefault(sample.kind, Counter())
        try:
            message = decoders[sample.message].decode(sample.payload, sample.encoding)
        except WireError as error:
            outcomes[error.reason] += 1
            report.longest_reason = max(report.longest_reason, len(str(error)))
            assert len(str(error)) <= LONGEST_REASON, (
                f"a reason of {len(str(error))} characters: {str(error)[:200]}"
            )
        else:
            assert type(message) is sample.message
            outcomes["taken"] += 1
            report.answers[f"{sample.message.__name__}: {taken(hal, message)}"] += 1
        if number % PER_TICK == 0:
            pass_tick(hal)
        if (number + 1) % max(payload_count // 10, 1) == 0:
            now = vitals(os.getpid())
            assert now is not None
            report.resident_mb.append(now.resident_mb)
    report.peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return report
