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
Doer = Literal["supervisor", "process", "writer", "module", "samples", "driver", "host", "simulator"]
DOERS: Mapping[Doer, str] = {
    "supervisor": "the supervisor, `snakesim run`",
    "process": "the process itself",
    "writer": "the publisher of the key",
    "module": "the module",
    "samples": "the host, in the samples",
    "driver": "the driver",
    "host": "the host",
    "simulator": "the simulator",
}

# Parts of a run, as `Injection.part` returns them; other parts are services, by name.
RUN = "run"
HAL = "hal"
CONTROL = "control"
ROUTER = "router"  # the Zenoh router of a run with --with-router

FORM = "KIND:TARGET@START, KIND:TARGET@START-END, or either with =AMOUNT; in seconds, such as mute:joint_3@2-3.5"
LONGEST_TEXT = 200  # characters of an injected fault in its text form
_text = re.compile(
    r"(?P<kind>[a-z_]+):(?P<target>[a-z0-9_/]+)@(?P<start>[0-9.]+)(-(?P<end>[0-9.]+))?(=(?P<amount>[-+0-9.e]+))?"
)
_numbered = re.compile(r"(?P<type>joint|bus)_(?P<number>[1-9][0-9]*)")


@dataclass(frozen=True)
class Amount:
    """The strength of an injected fault: the number behind `=`."""

    description: str  # what the number is
    unit: str  # "1": it has no unit
    default: float
    low: float
    high: float


@dataclass(frozen=True)
class Kind:
    """One kind of injected fault."""

    description: str
    by: tuple[Doer, ...]  # who carries it out; of two, the first one if it can
    amount: Amount | None = None  # none: it has no strength
    once: bool = False  # true: it happens at its start, and has no end
    in_module: str = ""  # what it does in a joint module, where that is more than `description`


SHARE = Amount("share of the messages", "1", 1.0, 0.0, 1.0)

KINDS: Mapping[TargetType, Mapping[str, Kind]] = {
    "process": {
        "kill": Kind("SIGKILL: terminated immediately", ("supervisor",), once=True),
        "stop": Kind("SIGTERM: ends in an orderly way", ("supervisor",), once=True),
        "freeze": Kind("SIGSTOP until the end: the process exists and sends nothing", ("supervisor",)),
        "hang": Kind(
            "its interpreter is busy until the end: connected, but does nothing",
            ("process",),
        ),
    },
    "key": {
        "drop": Kind("messages are lost", ("writer",), SHARE),
        "delay": Kind("messages arrive late", ("writer",), Amount("delay", "s", 0.05, 0.0, 10.0)),
        "duplicate": Kind("messages arrive twice", ("writer",), SHARE),
        "reorder": Kind("a message arrives after the one that follows it", ("writer",), SHARE),
        "corrupt": Kind("bytes of messages are changed", ("writer",), SHARE),
        "flood": Kind("the newest message is sent repeatedly", ("writer",), Amount("rate", "1/s", 5000.0, 1.0, 1e5)),
    },
    "joint": {
        "mute": Kind(
            "sends nothing", ("module", "samples"), in_module="sends nothing, but still follows its setpoints"
        ),
        "freeze": Kind(
            "repeats its last sample, whose age grows",
            ("module", "samples"),
            in_module="its main loop hangs: repeats its last joint state, no heartbeat, passive after its watchdog",
        ),
        "wrong": Kind("its angle is wrong", ("samples",), Amount("offset", "rad", 0.5, -6.3, 6.3)),
        "nan": Kind("its angle is NaN", ("samples",)),
        "reboot": Kind("its module restarts", ("module",), once=True),
        "counter": Kind("joint states with a wrong count", ("module",)),
        "checksum": Kind("joint states with a wrong checksum", ("module",)),
        "duplicate": Kind(
            "a second module or drive with the same id is on the bus",
            ("module",),
            in_module="a second module or drive with the same id and another serial number is on the bus",
        ),
        "overheat": Kind(
            "its winding is heated to 5 °C above `stop_at_c`, until the end of the fault if one is set",
            ("module",),
        ),
        "leak": Kind("detects water inside", ("module",)),
        "babble": Kind("sends its heartbeat as often as the bus allows", ("module",)),
        "undervoltage": Kind("its supply falls to 12 V", ("module",)),
    },
    "bus": {
        "cut": Kind("the interface goes down; it comes up again at the end", ("driver",)),
        "bus_off": Kind("the controller leaves the bus; it restarts at the end", ("driver",)),
        "error_passive": Kind("the controller has counted more than 127 errors", ("driver",), once=True),
        "overflow": Kind("received frames are lost", ("driver",), once=True),
        "full": Kind("the transmit queue is full", ("driver",)),
        "slow": Kind("each reading of it takes longer", ("driver",), Amount("by", "s", 0.02, 0.0, 1.0)),
    },
    "simulator": {
        "slow": Kind("runs at a share of real time", ("host",), Amount("share of real time", "1", 0.1, 0.001, 1.0)),
        "diverge": Kind("its state becomes impossible", ("simulator",), once=True),
    },
    "clock": {
        "step": Kind(
            "the wall clock jumps, with CAP_SYS_TIME",
            ("supervisor",),
            Amount("by", "s", 3600.0, -1e6, 1e6),
            once=True,
        ),
    },
}


@dataclass(frozen=True)
class Injection:
    """One fault that is injected for some time. Make it with `parse` or `checked`, which know what is allowed."""

    kind: str
    target: str
    start_s: float = 0.0  # robot time since the first arming; for emulators, time since their start
    end_s: float = inf
    amount: float | None = None

    @property
    def target_type(self) -> TargetType:
        """Return what sort of thing the fault happens to."""
        return target_type(self.target)

    @property
    def about(self) -> Kind:
        """Return the kind of fault, from the registry."""
        return KINDS[self.target_type][self.kind]

    @property
    def number(self) -> int:
        """Return the index of the joint or bus that is the target: from 0, joints from the tail."""
        match = _numbered.fullmatch(self.target)
        assert match is not None, f"{self.target} has no number"
        return int(match["number"]) - 1

    @property
    def part(self) -> str:
        """Return the part of a run that carries it out: the supervisor `run`, the host `hal`, or a service by name."""
        match self.about.by[0]:
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


def target_type(target: str) -> TargetType:
    """Return what sort of thing a target is, by its name."""
    numbered = _numbered.fullmatch(target)
    if numbered is not None:
        return "joint" if numbered["type"] == "joint" else "bus"
    if "/" in target:
        return "key"
    if target in ("simulator", "clock"):
        return target
    return "process"


OUTSIDE = ("operator", "preview")  # writers that are no part of a run


def find_writer(key: str) -> str:
    """Return the part of a run that writes a key.

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
    return row.kind in ("stream", "latched") and row.writer not in OUTSIDE


def parse_injection(text: str) -> Injection:
    """Return the injected fault that a text describes, such as `mute:joint_3@2-3.5`.

    Raises:
        ConfigError: The text is not valid, or the fault is not allowed.
    """
    if len(text) > LONGEST_TEXT:
        raise ConfigError(
            f"fault {text[:40]!r}...: {len(text)} characters, at most {LONGEST_TEXT}: give {FORM}",
            code="injection/unknown-fault",
        )
    match = _text.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"fault {text!r}: give {FORM}. Kinds: {kinds_in_short()}", code="injection/unknown-fault")
    amount: float | None = None
    try:
        start_s = float(match["start"])
        end_s = float(match["end"] or inf)
        if match["amount"] is not None:
            amount = float(match["amount"])
    except ValueError:
        raise ConfigError(
            f"fault {text!r}: start, end and amount are numbers, such as @2.0-3.5=0.3", code="injection/unknown-fault"
        ) from None
    if end_s <= start_s:
        raise ConfigError(
            f"fault {text!r}: it ends at {end_s:g} s, which must be later than its start, {start_s:g} s",
            code="injection/unknown-fault",
        )
    return check_injection(Injection(match["kind"], match["target"], start_s, end_s, amount), text)


def check_injection(injection: Injection, given_text: str | None = None) -> Injection:
    """Return the injected fault with the default of its amount filled in, if it is allowed.

    Args:
        injection: to check.
        given_text: how the user wrote it, for errors; None: its own text form.

    Raises:
        ConfigError: The target has no such kind of fault, the key has no writer, or the amount is not allowed.
    """
    text = str(injection) if given_text is None else given_text
    kind = KINDS[injection.target_type].get(injection.kind)
    if kind is None:
        raise _unknown_kind_error(injection, text)
    if injection.target_type == "key":
        find_writer(injection.target)  # raises for a key without a writer
    if kind.amount is None:
        if injection.amount is not None:
            raise ConfigError(
                f"fault {text!r}: {injection.kind} takes no amount; leave out ={injection.amount:g}",
                code="injection/unknown-fault",
            )
        return injection
    amount = kind.amount.default if injection.amount is None else injection.amount
    if not isfinite(amount) or not kind.amount.low <= amount <= kind.amount.high:
        raise ConfigError(
            f"fault {text!r}: {kind.amount.description} = {amount:g} must be from {kind.amount.low:g} to "
            f"{kind.amount.high:g} {kind.amount.unit}",
            code="injection/unknown-fault",
        )
    return replace(injection, amount=amount)


def _unknown_kind_error(injection: Injection, text: str) -> ConfigError:
    """Return the error for a kind that the target does not have; it names the targets that have this kind."""
    sort = injection.target_type
    others = [other for other in get_args(TargetType) if injection.kind in KINDS[other]]
    plurals = ["processes" if other == "process" else f"{other}s" for other in others]
    hint = f"; {injection.kind} is for {' and '.join(plurals)}" if plurals else ""
    return ConfigError(
        f"fault {text!r}: a {sort} such as {injection.target} knows no {injection.kind!r}, only "
        f"{', '.join(KINDS[sort])}{hint}",
        code="injection/unknown-fault",
    )


def check_targets(injections: Iterable[Injection], *, services: Iterable[str], joints: int, buses: int) -> None:
    """Check that a run has every target of its injected faults.

    Args:
        injections: the faults.
        services: names of the services that the run starts.
        joints: number of joints.
        buses: number of buses.

    Raises:
        ConfigError: The run has no such joint, bus, process or key, or the router does not support the fault.
    """
    processes = [*services, "host", ROUTER]
    for injection in injections:
        match injection.target_type:
            case "joint":
                _check_number(injection, "joint", joints)
            case "bus":
                _check_number(injection, "bus", buses)
            case "process":
                _check_process(injection, processes)
            case "key":
                _check_writer(injection, processes)
            case "simulator" | "clock":
                pass


def _check_number(injection: Injection, sort: str, count: int) -> None:
    """Raise ConfigError if the number of a joint or bus is above their count."""
    if injection.number >= count:
        has = f"{sort}_1 to {sort}_{count}" if count else f"no {sort}"
        raise ConfigError(
            f"fault {str(injection)!r}: there is no {injection.target}; this run has {has}",
            code="injection/unknown-target",
        )


def _check_process(injection: Injection, processes: list[str]) -> None:
    """Raise ConfigError if the run has no such process, or the router cannot do it."""
    if injection.target not in processes:
        raise ConfigError(
            f"fault {str(injection)!r}: there is no process {injection.target!r}; this run has {', '.join(processes)}",
            code="injection/unknown-target",
        )
    if injection.target == ROUTER and injection.part != RUN:
        possible = [name for name, kind in KINDS["process"].items() if "supervisor" in kind.by]
        raise ConfigError(
            f"fault {str(injection)!r}: a router cannot {injection.kind}, only {', '.join(possible)}",
            code="injection/not-supported",
        )


def _check_writer(injection: Injection, processes: list[str]) -> None:
    """Raise ConfigError if the run does not start the process that writes the key."""
    writer = injection.part
    if writer not in processes and writer != HAL:
        raise ConfigError(
            f"fault {str(injection)!r}: {writer} writes {injection.target}, and this run does not start it",
            code="injection/unknown-target",
        )


@dataclass(frozen=True)
class Change:
    """The time at which an injected fault begins or ends."""

    at_s: float
    injection: Injection
    begins: bool


class InjectionPlan:
    """The beginnings and ends of injected faults, in the order of time."""

    def __init__(self, injections: Iterable[Injection] = ()) -> None:
        self._changes: list[Change] = []
        for injection in injections:
            self.add(injection)

    def add(self, injection: Injection) -> None:
        """Add an injected fault to the plan."""
        self._changes.append(Change(injection.start_s, injection, True))
        if injection.end_s != inf and not injection.about.once:
            self._changes.append(Change(injection.end_s, injection, False))
        self._changes.sort(key=lambda change: change.at_s)

    def next_s(self) -> float:
        """Return the time of the next change; inf if there is none left."""
        return self._changes[0].at_s if self._changes else inf

    def until(self, now_s: float) -> list[Change]:
        """Remove the changes that are due by now from the plan, and return them."""
        due = [change for change in self._changes if change.at_s <= now_s]
        self._changes = self._changes[len(due) :]
        return due


def explain_kinds() -> str:
    """Return a list of every kind, for a command's help."""
    lines: list[str] = []
    for sort, kinds in KINDS.items():
        lines.append(f"{sort}:")
        for name, kind in kinds.items():
            lines.append(f"  {name:<14} {kind.description}{_explain_amount(kind.amount)}")
    return "\n".join(lines)


def _explain_amount(amount: Amount | None) -> str:
    """Return what the amount of a kind is, and its default; empty if the kind has none."""
    if amount is None:
        return ""
    unit = "" if amount.unit == "1" else f" {amount.unit}"
    return f"; amount: {amount.description}, {amount.default:g}{unit} by default"


def kinds_in_short() -> str:
    """Return the names of all kinds in one line, by the sort of target."""
    return "; ".join(f"{sort}: {', '.join(kinds)}" for sort, kinds in KINDS.items())
