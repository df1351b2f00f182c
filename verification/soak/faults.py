"""Which faults a soak draws from, and what must follow from each. Pure, and repeatable by its seed."""

import itertools
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from snakesim_hal.model.fault_kinds import (
    FAULT_KINDS,
    FaultInjection,
    TargetType,
    validate_and_complete_injection,
)
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import FaultRequest

Follows = Literal["stop", "restart", "perhaps"]

SORTS: tuple[TargetType, ...] = ("process", "process", "key", "key", "joint", "bus", "simulator")
SERVICES = ("guidance", "navigation", "control")
SPOILT_KEYS = (
    keys.JOINT_COMMAND,
    keys.CLOCK,
    keys.JOINTS,
    keys.POSE,
    keys.CONTACTS,
    keys.WORLD,
    keys.TRAJECTORY,
)
DISTURBED_KEYS = (*SPOILT_KEYS, keys.IMU, keys.APPLIED, keys.STATUS, keys.CONTROL_STATE)
# The wall clock belongs to the machine, and to everybody on it: stepping it is a row of the fault table, not of a soak.
TARGETS: Mapping[TargetType, tuple[str, ...]] = {
    "process": (*SERVICES, "host"),
    "key": DISTURBED_KEYS,
    "joint": (),  # as the robot has them
    "bus": ("bus_1",),
    "simulator": ("simulator",),
}
AMOUNTS: Mapping[str, tuple[float, ...]] = {
    "drop": (0.1, 0.5, 1.0),
    "delay": (0.01, 0.1, 0.5),
    "duplicate": (0.5, 1.0),
    "reorder": (0.3, 1.0),
    "corrupt": (0.1, 1.0),
    "flood": (500.0, 2000.0),
    "wrong": (-0.5, 0.4, 1.0),
    "slow": (0.3, 0.7),
}
LASTS_S = (0.2, 0.5, 1.0, 2.0)
LONG_FREEZE_S = 0.5  # beyond any doubt longer than a lease


@dataclass(frozen=True)
class SoakEvent:
    """One fault of a soak."""

    number: int
    pause_s: float  # before it, with the robot armed
    request: FaultRequest
    part: str  # who is asked
    lasts_s: float
    follows: Follows
    names: tuple[str, ...]  # one of these stands in the cause of every fault that follows

    @property
    def end_request(self) -> FaultRequest | None:
        """How a person ends it; None when it ends by itself, or has no end."""
        about = FAULT_KINDS[FaultInjection(self.request.kind, self.request.target).target_type][
            self.request.kind
        ]
        if about.is_instantaneous or self.request.for_s is not None:
            return None
        return FaultRequest(kind=self.request.kind, target=self.request.target, end=True)

    def __str__(self) -> str:
        amount = "" if self.request.amount is None else f"={self.request.amount:g}"
        return f"#{self.number} {self.request.kind}:{self.request.target}{amount} for {self.lasts_s:g} s"


class EventDrawer:
    """Draws events; the same ones for the same seed, as long as the same ones are found impossible."""

    def __init__(self, seed: int, joint_count: int) -> None:
        self._random = random.Random(seed)
        self._targets: dict[TargetType, tuple[str, ...]] = {
            **TARGETS,
            "joint": tuple(f"joint_{i + 1}" for i in range(joint_count)),
        }
        self._impossible: set[tuple[TargetType, str]] = set()

    def rule_out(self, event: SoakEvent) -> None:
        """This backend cannot do it."""
        injection = FaultInjection(event.request.kind, event.request.target)
        self._impossible.add((injection.target_type, injection.kind))

    def events(self) -> Iterator[SoakEvent]:
        """One after the other, without end."""
        for number in itertools.count(1):
            yield self._draw(number)

    def _draw(self, number: int) -> SoakEvent:
        dice = self._random
        while True:
            sort = dice.choice(SORTS)
            kind = dice.choice(list(FAULT_KINDS[sort]))
            target = dice.choice(self._targets[sort])
            amount = (
                dice.choice(AMOUNTS[kind])
                if kind in AMOUNTS and FAULT_KINDS[sort][kind].amount is not None
                else None
            )
            lasts_s, pause_s, by_itself = (
                dice.choice(LASTS_S),
                dice.uniform(0.5, 3.0),
                dice.random() < 0.5,
            )
            if (sort, kind) in self._impossible or (
                kind == "corrupt" and target not in SPOILT_KEYS
            ):
                continue
            injection = validate_and_complete_injection(
                FaultInjection(kind, target, 0.0, lasts_s, amount)
            )
            once = injection.kind_info.is_instantaneous
            by_itself |= (kind, target) == ("freeze", "host")  # nobody can ask for its end
            request = FaultRequest(
                kind=kind,
                target=target,
                amount=amount,
                for_s=lasts_s if by_itself and not once else None,
            )
            follows, names = _follows(injection)
            return SoakEvent(
                number,
                pause_s,
                request,
                injection.executing_part,
                0.0 if once else lasts_s,
                follows,
                names,
            )


def _follows(injection: FaultInjection) -> tuple[Follows, tuple[str, ...]]:
    """What comes of it, and whom the causes of faults may name."""
    kind, target, lasts_s = injection.kind, injection.target, injection.end_s
    match injection.target_type:
        case "process" if target == "host":
            return ("restart" if kind in ("kill", "stop") else "perhaps"), (
                "host",
                "control",
                "lease",
            )
        case "process" if target == "control":
            sure = kind in ("kill", "stop") or lasts_s >= LONG_FREEZE_S
            return ("stop" if sure else "perhaps"), ("control",)
        case "process":
            return "perhaps", (target, "control")
        case "key":
            starves = target == keys.JOINT_COMMAND and (
                (kind in ("drop", "corrupt") and injection.amount == 1.0)
                or (kind == "delay" and (injection.amount or 0.0) > 0.1)
            )
            sure = starves and lasts_s >= LONG_FREEZE_S
            return ("stop" if sure else "perhaps"), (target, "control", "joint")
        case "joint":
            sure = kind in ("mute", "nan") and lasts_s >= LONG_FREEZE_S
            return ("stop" if sure else "perhaps"), (target, "control")
        case "bus":
            return "perhaps", (target, "virtual-", "joint", "control", "can")
        case _:
            return "perhaps", ("simulat", "diverge", "control", "joint")
