"""A run: decode sample after sample, let a HAL act on what decodes, and keep count."""

import os
import random
import resource
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from snakesim_hal.errors import WireError
from snakesim_hal.wire.codec import Decoder, encode, encoding_of
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
from tests.fuzz.payloads import Maker
from tests.fuzz.vitals import vitals
from tests.unit.hal.rig import PERIOD_NS
from tests.unit.hal.safety.authority_rig import armed

LONGEST_REASON = 400  # characters of an error's text, whatever a sender wrote
PER_ROBOT = 1000  # payloads until a fresh robot is armed
PER_TICK = 10


@dataclass
class Report:
    """What became of the samples."""

    outcomes: dict[str, Counter[str]] = field(default_factory=dict[str, Counter[str]])  # by kind of mutation
    answers: Counter[str] = field(default_factory=Counter[str])  # what a HAL did with what decoded
    resident_mb: list[float] = field(default_factory=list[float])  # ten times in a run
    peak_mb: float = 0.0
    longest_reason: int = 0

    @property
    def growth_mb(self) -> float:
        """Memory gained since the first tenth of the run."""
        return self.resident_mb[-1] - self.resident_mb[0]


class Robot:
    """A HAL without a network: acts on messages as the host does."""

    def __init__(self) -> None:
        """Armed and commanded."""
        self._rig = armed()
        self._authority = self._rig.authority
        self._decoder = Decoder(Answer)

    def take(self, message: Message) -> str:
        """What became of it, in a word."""
        rig = self._rig
        answer: Answer
        match message:
            case JointCommand():
                return self._authority.offer(message, now_ns=rig.now_ns, tick=rig.tick, age_ns=0) or "accepted"
            case JointState():
                self._authority.observe(message)
                return "observed"
            case LeaseRequest():
                answer = self._authority.on_lease(message, rig.now_ns)
            case LifecycleRequest():
                answer = self._authority.on_lifecycle(message, rig.now_ns)
            case EstopRequest():
                answer = self._authority.on_estop(message, rig.tick)
            case _:
                return "not for a HAL"
        assert self._decoder.decode(encode(answer), encoding_of(Answer)) == answer
        return "yes" if answer.ok else "no"

    def pass_tick(self) -> None:
        """The end of a tick."""
        self._rig.now_ns += PERIOD_NS // 4
        self._rig.tick += 1
        self._authority.expire(self._rig.now_ns, self._rig.tick)
        points = self._authority.decide().set_points
        assert all(abs(target) <= 5.0 for target in points.target)


def run(payloads: int, seed: int) -> Report:
    """Raises whatever a decoder or the authority raises that it must not."""
    maker, report = Maker(random.Random(seed)), Report()
    decoders: dict[type[Message], Decoder[Any]] = {message: Decoder(message) for message in VERSIONS}
    robot = Robot()
    for number in range(payloads):
        if number % PER_ROBOT == 0:
            robot = Robot()
        sample = maker.make()
        outcomes = report.outcomes.setdefault(sample.kind, Counter())
        try:
            message = decoders[sample.message].decode(sample.payload, sample.encoding)
        except WireError as error:
            outcomes[error.reason] += 1
            report.longest_reason = max(report.longest_reason, len(str(error)))
            assert len(str(error)) <= LONGEST_REASON, f"a reason of {len(str(error))} characters: {str(error)[:200]}"
        else:
            assert type(message) is sample.message
            outcomes["taken"] += 1
            report.answers[f"{sample.message.__name__}: {robot.take(message)}"] += 1
        if number % PER_TICK == 0:
            robot.pass_tick()
        if (number + 1) % max(payloads // 10, 1) == 0:
            now = vitals(os.getpid())
            assert now is not None
            report.resident_mb.append(now.resident_mb)
    report.peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return report
