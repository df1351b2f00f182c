"""Draws the faults of a soak at random, and states what must follow from each. The same seed draws the same faults."""

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

# What follows from a fault: the robot stops, the host restarts, or either may happen or not.
Consequence = Literal["stop", "restart", "perhaps"]

# A type that is listed twice is drawn twice as often.
TARGET_TYPES: tuple[TargetType, ...] = (
    "process",
    "process",
    "key",
    "key",
    "joint",
    "bus",
    "simulator",
)
SERVICES = ("guidance", "navigation", "control")
CORRUPTED_KEYS = (
    keys.JOINT_COMMAND,
    keys.CLOCK,
    keys.JOINTS,
    keys.POSE,
    keys.CONTACTS,
    keys.WORLD,
    keys.TRAJECTORY,
)
DISTURBED_KEYS = (*CORRUPTED_KEYS, keys.IMU, keys.APPLIED, keys.STATUS, keys.CONTROL_STATE)
# A step of the wall clock is not among them, because it affects every process of the computer. The fault table has it.
TARGETS: Mapping[TargetType, tuple[str, ...]] = {
    "process": (*SERVICES, "host"),
    "key": DISTURBED_KEYS,
    "joint": (),  # the joints of the robot
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
DURATIONS_S = (0.2, 0.5, 1.0, 2.0)
MIN_PAUSE_S = 0.5
MAX_PAUSE_S = 3.0
LONG_FREEZE_S = 0.5  # longer than any lease
LONG_DELAY_S = 0.1  # older commands are rejected
ENDS_BY_ITSELF_PROBABILITY = 0.5


@dataclass(frozen=True)
class SoakEvent:
    """One fault of a soak, and what must follow from it."""

    number: int
    pause_s: float  # with the robot armed, before the fault
    request: FaultRequest
    part: str  # which gets the request
    duration_s: float
    consequence: Consequence
    expected_names: tuple[str, ...]  # one of them is in the cause of every fault that follows

    @property
    def end_request(self) -> FaultRequest | None:
        """The request that ends the fault; None if it ends by itself, or has no end."""
        kind = self.request.kind
        target = self.request.target
        target_type = FaultInjection(kind, target).target_type
        if FAULT_KINDS[target_type][kind].is_instantaneous or self.request.for_s is not None:
            return None
        return FaultRequest(kind=kind, target=target, end=True)

    def __str__(self) -> str:
        amount = "" if self.request.amount is None else f"={self.request.amount:g}"
        fault = f"{self.request.kind}:{self.request.target}{amount}"
        return f"#{self.number} {fault} for {self.duration_s:g} s"


class EventDrawer:
    """Draws events. The same seed draws the same events, as long as the same faults are ruled out."""

    def __init__(self, seed: int, joint_count: int) -> None:
        """Create the drawer.

        Args:
            seed: Selects the events.
            joint_count: The number of joints of the robot.
        """
        self._random = random.Random(seed)
        joint_names = tuple(f"joint_{i + 1}" for i in range(joint_count))
        self._targets: dict[TargetType, tuple[str, ...]] = {**TARGETS, "joint": joint_names}
        self._ruled_out: set[tuple[TargetType, str]] = set()

    def rule_out(self, event: SoakEvent) -> None:
        """Draw no more events of this kind, because the backend cannot inject them."""
        injection = FaultInjection(event.request.kind, event.request.target)
        self._ruled_out.add((injection.target_type, injection.kind))

    def draw_events(self) -> Iterator[SoakEvent]:
        """Draw one event after the other, without end."""
        for number in itertools.count(1):
            yield self._draw_event(number)

    def _draw_event(self, number: int) -> SoakEvent:
        chance = self._random
        while True:
            target_type = chance.choice(TARGET_TYPES)
            kind = chance.choice(list(FAULT_KINDS[target_type]))
            target = chance.choice(self._targets[target_type])
            amount = self._draw_amount(target_type, kind)
            duration_s = chance.choice(DURATIONS_S)
            pause_s = chance.uniform(MIN_PAUSE_S, MAX_PAUSE_S)
            ends_by_itself = chance.random() < ENDS_BY_ITSELF_PROBABILITY
            if (target_type, kind) in self._ruled_out:
                continue
            if kind == "corrupt" and target not in CORRUPTED_KEYS:
                continue
            break
        injection = validate_and_complete_injection(
            FaultInjection(kind, target, 0.0, duration_s, amount)
        )
        is_instantaneous = injection.kind_info.is_instantaneous
        if (kind, target) == ("freeze", "host"):  # a frozen host gets no request to end it
            ends_by_itself = True
        request = FaultRequest(
            kind=kind,
            target=target,
            amount=amount,
            for_s=duration_s if ends_by_itself and not is_instantaneous else None,
        )
        return SoakEvent(
            number=number,
            pause_s=pause_s,
            request=request,
            part=injection.executing_part,
            duration_s=0.0 if is_instantaneous else duration_s,
            consequence=_find_consequence(injection),
            expected_names=_list_expected_names(injection),
        )

    def _draw_amount(self, target_type: TargetType, kind: str) -> float | None:
        if kind not in AMOUNTS or FAULT_KINDS[target_type][kind].amount is None:
            return None
        return self._random.choice(AMOUNTS[kind])


def _find_consequence(injection: FaultInjection) -> Consequence:
    """Find what must follow from a fault."""
    kind = injection.kind
    target = injection.target
    is_long = injection.end_s >= LONG_FREEZE_S
    match injection.target_type:
        case "process" if target == "host":
            return "restart" if kind in ("kill", "stop") else "perhaps"
        case "process" if target == "control":
            return "stop" if kind in ("kill", "stop") or is_long else "perhaps"
        case "key":
            return "stop" if _withholds_commands(injection) and is_long else "perhaps"
        case "joint":
            return "stop" if kind in ("mute", "nan") and is_long else "perhaps"
        case _:
            return "perhaps"


def _withholds_commands(injection: FaultInjection) -> bool:
    """Return whether no valid command reaches the host in time."""
    if injection.target != keys.JOINT_COMMAND:
        return False
    match injection.kind:
        case "drop" | "corrupt":
            return injection.amount == 1.0
        case "delay":
            return (injection.amount or 0.0) > LONG_DELAY_S
        case _:
            return False


def _list_expected_names(injection: FaultInjection) -> tuple[str, ...]:
    """List the names of which one must be in the cause of every fault that follows."""
    target = injection.target
    match injection.target_type:
        case "process" if target == "host":
            return "host", "control", "lease"
        case "process" if target == "control":
            return ("control",)
        case "process" | "joint":
            return target, "control"
        case "key":
            return target, "control", "joint"
        case "bus":
            return target, "virtual-", "joint", "control", "can"
        case _:
            return "simulat", "diverge", "control", "joint"
