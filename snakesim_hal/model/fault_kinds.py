"""The registry of all kinds of injected faults, and their text form in files, commands and emulators.

    kill:control@2                  at 2 s of robot time after the first arming
    drop:actuator/joints@2-4=0.3    from 2 s to 4 s, three of ten messages
    mute:joint_3@5-6.5              joint_3 sends nothing for 1.5 s

This module defines what an injected fault means and which part of a run carries it out. It carries out nothing itself.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import Literal, get_args

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire import keys

TargetType = Literal["process", "key", "joint", "bus", "simulator", "clock"]
FaultExecutor = Literal[
    "supervisor", "process", "writer", "module", "samples", "driver", "host", "simulator"
]
EXECUTOR_DESCRIPTIONS: Mapping[FaultExecutor, str] = {
    "supervisor": "the supervisor, `snakesim run`",
    "process": "the process itself",
    "writer": "the publisher of the key",
    "module": "the module",
    "samples": "the host, in the samples",
    "driver": "the driver",
    "host": "the host",
    "simulator": "the simulator",
}

# Parts of a run, as `FaultInjection.part` returns them; other parts are services, by name.
RUN = "run"
HAL = "hal"
CONTROL = "control"
ROUTER = "router"  # the Zenoh router of a run with --with-router

TEXT_FORMAT = "KIND:TARGET@START, KIND:TARGET@START-END, or either with =AMOUNT; in seconds, such as mute:joint_3@2-3.5"
MAX_TEXT_LENGTH = 200  # characters of an injected fault in its text form
_TEXT_PATTERN = re.compile(
    r"(?P<kind>[a-z_]+):(?P<target>[a-z0-9_/]+)@(?P<start>[0-9.]+)(-(?P<end>[0-9.]+))?(=(?P<amount>[-+0-9.e]+))?"
)
_NUMBERED_TARGET_PATTERN = re.compile(r"(?P<type>joint|bus)_(?P<number>[1-9][0-9]*)")


@dataclass(frozen=True)
class FaultAmount:
    """The strength of an injected fault: the number behind `=`."""

    description: str  # what the number is
    unit: str  # "1": it has no unit
    default: float
    min_value: float
    max_value: float


@dataclass(frozen=True)
class FaultKind:
    """One kind of injected fault."""

    description: str
    # What can carry it out; of two, the first one if it supports the kind.
    executors: tuple[FaultExecutor, ...]
    amount: FaultAmount | None = None  # None if the kind has no strength
    is_instantaneous: bool = False  # True if it happens at its start, and has no end
    # What it does in a joint module, where that is more than `description`.
    module_description: str = ""


MESSAGE_FRACTION = FaultAmount("share of the messages", "1", 1.0, 0.0, 1.0)

FAULT_KINDS: Mapping[TargetType, Mapping[str, FaultKind]] = {
    "process": {
        "kill": FaultKind(
            "SIGKILL: terminated immediately", ("supervisor",), is_instantaneous=True
        ),
        "stop": FaultKind(
            "SIGTERM: ends in an orderly way", ("supervisor",), is_instantaneous=True
        ),
        "freeze": FaultKind(
            "SIGSTOP until the end: the process exists and sends nothing", ("supervisor",)
        ),
        "hang": FaultKind(
            "its interpreter is busy until the end: connected, but does nothing",
            ("process",),
        ),
    },
    "key": {
        "drop": FaultKind("messages are lost", ("writer",), MESSAGE_FRACTION),
        "delay": FaultKind(
            "messages arrive late", ("writer",), FaultAmount("delay", "s", 0.05, 0.0, 10.0)
        ),
        "duplicate": FaultKind("messages arrive twice", ("writer",), MESSAGE_FRACTION),
        "reorder": FaultKind(
            "a message arrives after the one that follows it", ("writer",), MESSAGE_FRACTION
        ),
        "corrupt": FaultKind("bytes of messages are changed", ("writer",), MESSAGE_FRACTION),
        "flood": FaultKind(
            "the newest message is sent repeatedly",
            ("writer",),
            FaultAmount("rate", "1/s", 5000.0, 1.0, 1e5),
        ),
    },
    "joint": {
        "mute": FaultKind(
            "sends nothing",
            ("module", "samples"),
            module_description="sends nothing, but still follows its setpoints",
        ),
        "freeze": FaultKind(
            "repeats its last sample, whose age grows",
            ("module", "samples"),
            module_description=(
                "its main loop hangs: repeats its last joint state, no heartbeat, passive after its watchdog"
            ),
        ),
        "wrong": FaultKind(
            "its angle is wrong", ("samples",), FaultAmount("offset", "rad", 0.5, -6.3, 6.3)
        ),
        "nan": FaultKind("its angle is NaN", ("samples",)),
        "reboot": FaultKind("its module restarts", ("module",), is_instantaneous=True),
        "counter": FaultKind("joint states with a wrong count", ("module",)),
        "checksum": FaultKind("joint states with a wrong checksum", ("module",)),
        "duplicate": FaultKind(
            "a second module or drive with the same id is on the bus",
            ("module",),
            module_description="a second module or drive with the same id and another serial number is on the bus",
        ),
        "overheat": FaultKind(
            "its winding is heated to 5 °C above `stop_at_c`, until the end of the fault if one is set",
            ("module",),
        ),
        "leak": FaultKind("detects water inside", ("module",)),
        "babble": FaultKind("sends its heartbeat as often as the bus allows", ("module",)),
        "undervoltage": FaultKind("its supply falls to 12 V", ("module",)),
    },
    "bus": {
        "cut": FaultKind("the interface goes down; it comes up again at the end", ("driver",)),
        "bus_off": FaultKind("the controller leaves the bus; it restarts at the end", ("driver",)),
        "error_passive": FaultKind(
            "the controller has counted more than 127 errors", ("driver",), is_instantaneous=True
        ),
        "overflow": FaultKind("received frames are lost", ("driver",), is_instantaneous=True),
        "full": FaultKind("the transmit queue is full", ("driver",)),
        "slow": FaultKind(
            "each reading of it takes longer", ("driver",), FaultAmount("by", "s", 0.02, 0.0, 1.0)
        ),
    },
    "simulator": {
        "slow": FaultKind(
            "runs at a share of real time",
            ("host",),
            FaultAmount("share of real time", "1", 0.1, 0.001, 1.0),
        ),
        "diverge": FaultKind("its state becomes impossible", ("simulator",), is_instantaneous=True),
    },
    "clock": {
        "step": FaultKind(
            "the wall clock jumps, with CAP_SYS_TIME",
            ("supervisor",),
            FaultAmount("by", "s", 3600.0, -1e6, 1e6),
            is_instantaneous=True,
        ),
    },
}


@dataclass(frozen=True)
class FaultInjection:
    """One fault that is injected for some time. Make it with `parse` or `checked`, which know what is allowed."""

    kind: str
    target: str
    start_s: float = 0.0  # robot time since the first arming; for emulators, time since their start
    end_s: float = inf
    amount: float | None = None

    @property
    def target_type(self) -> TargetType:
        """Return what sort of thing the fault happens to."""
        return infer_target_type(self.target)

    @property
    def kind_info(self) -> FaultKind:
        """Return the kind of fault, from the registry."""
        return FAULT_KINDS[self.target_type][self.kind]

    @property
    def target_index(self) -> int:
        """Return the index of the joint or bus that is the target: from 0, joints from the tail."""
        match = _NUMBERED_TARGET_PATTERN.fullmatch(self.target)
        assert match is not None, f"{self.target} has no number"
        return int(match["number"]) - 1

    @property
    def executing_part(self) -> str:
        """Return the part of a run that carries it out: the supervisor `run`, the host `hal`, or a service by name."""
        match self.kind_info.executors[0]:
            case "supervisor":
                return RUN
            case "process":
                return HAL if self.target == "host" else self.target
            case "writer":
                return find_writer(self.target)
            case _:
                return HAL

    def __str__(self) -> str:
        text = f"{self.kind}:{self.target}@{self.start_s:.12g}"
        if self.end_s != inf:
            text += f"-{self.end_s:.12g}"
        if self.amount is not None:
            text += f"={self.amount:.12g}"
        return text


def infer_target_type(target: str) -> TargetType:
    """Return what sort of thing a target is, by its name."""
    numbered = _NUMBERED_TARGET_PATTERN.fullmatch(target)
    if numbered is not None:
        return "joint" if numbered["type"] == "joint" else "bus"
    if "/" in target:
        return "key"
    if target in ("simulator", "clock"):
        return target
    return "process"


EXTERNAL_WRITERS = ("operator", "preview")  # writers that are no part of a run


def find_writer(key: str) -> str:
    """Return the part of a run that writes a key: HAL, CONTROL or the name of another service.

    Raises:
        ConfigError: No part of a run writes the key.
    """
    row = keys.find_row(key)
    if row is None or not _is_written_by_run(row):
        streams = [row.key for row in keys.SPACE if _is_written_by_run(row)]
        raise ConfigError(
            f"{key!r}: no part of a run writes this key; those with a writer are {', '.join(streams)}",
            code="injection/unknown-target",
        )
    if row.key == keys.DONE_ALL:
        return keys.parse_service(key)
    match row.writer:
        case "HAL":
            return HAL
        case "lease holder":
            return CONTROL
        case service:
            return service


def _is_written_by_run(row: keys.KeyRow) -> bool:
    """Return whether a part of a run publishes messages under the keys of a row."""
    return row.kind in ("stream", "latched") and row.writer not in EXTERNAL_WRITERS


def parse_injection(text: str) -> FaultInjection:
    """Parse the text form of an injected fault, such as `mute:joint_3@2-3.5`, and validate the fault.

    Args:
        text: Text in the form `TEXT_FORMAT`.

    Returns:
        The fault, with the default of its amount filled in if the text has no amount.

    Raises:
        ConfigError: The text is not valid, or the fault is not allowed.
    """
    if len(text) > MAX_TEXT_LENGTH:
        raise ConfigError(
            f"fault {text[:40]!r}...: {len(text)} characters, at most {MAX_TEXT_LENGTH}: give {TEXT_FORMAT}",
            code="injection/unknown-fault",
        )
    match = _TEXT_PATTERN.fullmatch(text.strip())
    if match is None:
        raise ConfigError(
            f"fault {text!r}: give {TEXT_FORMAT}. Kinds: {summarize_fault_kinds()}",
            code="injection/unknown-fault",
        )
    amount: float | None = None
    try:
        start_s = float(match["start"])
        end_s = float(match["end"] or inf)
        if match["amount"] is not None:
            amount = float(match["amount"])
    except ValueError:
        raise ConfigError(
            f"fault {text!r}: start, end and amount are numbers, such as @2.0-3.5=0.3",
            code="injection/unknown-fault",
        ) from None
    if end_s <= start_s:
        raise ConfigError(
            f"fault {text!r}: it ends at {end_s:g} s, which must be later than its start, {start_s:g} s",
            code="injection/unknown-fault",
        )
    return validate_and_complete_injection(
        FaultInjection(match["kind"], match["target"], start_s, end_s, amount), text
    )


def validate_and_complete_injection(
    injection: FaultInjection, given_text: str | None = None
) -> FaultInjection:
    """Check that an injected fault is allowed, and return it with the default of its amount filled in.

    Args:
        injection: Fault to check.
        given_text: Text of the fault as the user wrote it, for errors. None for the text form of `injection`.

    Raises:
        ConfigError: The target has no such kind of fault, the key has no writer, or the amount is not allowed.
    """
    text = str(injection) if given_text is None else given_text
    kind = FAULT_KINDS[injection.target_type].get(injection.kind)
    if kind is None:
        raise _unknown_kind_error(injection, text)
    if injection.target_type == "key":
        find_writer(injection.target)  # raises ConfigError for a key without a writer
    if kind.amount is None:
        if injection.amount is not None:
            raise ConfigError(
                f"fault {text!r}: {injection.kind} takes no amount; leave out ={injection.amount:g}",
                code="injection/unknown-fault",
            )
        return injection
    amount = kind.amount.default if injection.amount is None else injection.amount
    if not isfinite(amount) or not kind.amount.min_value <= amount <= kind.amount.max_value:
        raise ConfigError(
            f"fault {text!r}: {kind.amount.description} = {amount:g} must be from {kind.amount.min_value:g} to "
            f"{kind.amount.max_value:g} {kind.amount.unit}",
            code="injection/unknown-fault",
        )
    return replace(injection, amount=amount)


def _unknown_kind_error(injection: FaultInjection, text: str) -> ConfigError:
    """Return the error for a kind that the target does not have; it names the targets that have this kind."""
    sort = injection.target_type
    others = [other for other in get_args(TargetType) if injection.kind in FAULT_KINDS[other]]
    plurals = ["processes" if other == "process" else f"{other}s" for other in others]
    hint = f"; {injection.kind} is for {' and '.join(plurals)}" if plurals else ""
    return ConfigError(
        f"fault {text!r}: a {sort} such as {injection.target} knows no {injection.kind!r}, only "
        f"{', '.join(FAULT_KINDS[sort])}{hint}",
        code="injection/unknown-fault",
    )


def validate_injection_targets(
    injections: Iterable[FaultInjection],
    *,
    services: Iterable[str],
    joint_count: int,
    bus_count: int,
) -> None:
    """Raise ConfigError unless a run has every target of its injected faults.

    Args:
        injections: Injected faults.
        services: Names of the services that the run starts.
        joint_count: Number of joints of the robot.
        bus_count: Number of buses of the backend.

    Raises:
        ConfigError: The run has no such joint, bus, process or key, or the router does not support the fault.
    """
    processes = [*services, "host", ROUTER]
    for injection in injections:
        match injection.target_type:
            case "joint":
                _validate_target_index(injection, "joint", joint_count)
            case "bus":
                _validate_target_index(injection, "bus", bus_count)
            case "process":
                _validate_target_process(injection, processes)
            case "key":
                _validate_key_writer(injection, processes)
            case "simulator" | "clock":
                pass


def _validate_target_index(injection: FaultInjection, target_type: str, count: int) -> None:
    """Raise ConfigError if there is no joint or bus of this number."""
    if injection.target_index >= count:
        available = f"{target_type}_1 to {target_type}_{count}" if count else f"no {target_type}"
        raise ConfigError(
            f"fault {str(injection)!r}: there is no {injection.target}; this run has {available}",
            code="injection/unknown-target",
        )


def _validate_target_process(injection: FaultInjection, processes: list[str]) -> None:
    """Raise ConfigError if the run has no such process, or if the router does not support the fault."""
    if injection.target not in processes:
        raise ConfigError(
            f"fault {str(injection)!r}: there is no process {injection.target!r}; this run has {', '.join(processes)}",
            code="injection/unknown-target",
        )
    if injection.target == ROUTER and injection.executing_part != RUN:
        possible = [
            name for name, kind in FAULT_KINDS["process"].items() if "supervisor" in kind.executors
        ]
        raise ConfigError(
            f"fault {str(injection)!r}: a router cannot {injection.kind}, only {', '.join(possible)}",
            code="injection/not-supported",
        )


def _validate_key_writer(injection: FaultInjection, processes: list[str]) -> None:
    """Raise ConfigError if the run does not start the process that writes the key."""
    writer = injection.executing_part
    if writer not in processes and writer != HAL:
        raise ConfigError(
            f"fault {str(injection)!r}: {writer} writes {injection.target}, and this run does not start it",
            code="injection/unknown-target",
        )


@dataclass(frozen=True)
class FaultTransition:
    """The time at which an injected fault starts or ends."""

    time_s: float
    injection: FaultInjection
    is_start: bool


class InjectionPlan:
    """The starts and ends of injected faults, in the order of time."""

    def __init__(self, injections: Iterable[FaultInjection] = ()) -> None:
        self._transitions: list[FaultTransition] = []
        for injection in injections:
            self.add(injection)

    def add(self, injection: FaultInjection) -> None:
        """Add an injected fault to the plan."""
        self._transitions.append(FaultTransition(injection.start_s, injection, True))
        if injection.end_s != inf and not injection.kind_info.is_instantaneous:
            self._transitions.append(FaultTransition(injection.end_s, injection, False))
        self._transitions.sort(key=lambda transition: transition.time_s)

    def next_transition_s(self) -> float:
        """Return the time of the next transition; inf if none is left."""
        return self._transitions[0].time_s if self._transitions else inf

    def pop_due_transitions(self, now_s: float) -> list[FaultTransition]:
        """Remove the transitions that are due by now from the plan, and return them."""
        due_transitions = [
            transition for transition in self._transitions if transition.time_s <= now_s
        ]
        self._transitions = self._transitions[len(due_transitions) :]
        return due_transitions


def describe_fault_kinds() -> str:
    """Return a list of every kind, for a command's help."""
    lines: list[str] = []
    for sort, kinds in FAULT_KINDS.items():
        lines.append(f"{sort}:")
        for name, kind in kinds.items():
            lines.append(f"  {name:<14} {kind.description}{_describe_amount(kind.amount)}")
    return "\n".join(lines)


def _describe_amount(amount: FaultAmount | None) -> str:
    """Return what the amount of a kind is, and its default; empty if the kind has none."""
    if amount is None:
        return ""
    unit = "" if amount.unit == "1" else f" {amount.unit}"
    return f"; amount: {amount.description}, {amount.default:g}{unit} by default"


def summarize_fault_kinds() -> str:
    """Return the names of all kinds in one line, by the sort of target."""
    return "; ".join(f"{sort}: {', '.join(kinds)}" for sort, kinds in FAULT_KINDS.items())
