"""What can be made to go wrong on request: the one registry of kinds, and the words for files, commands and emulators.

    kill:control@2            at 2 s of robot time after the first arming
    drop:actuator/joints@2-4=0.3    from 2 s to 4 s, three of ten
    mute:joint_3@5-6.5        joint_3 says nothing for 1.5 s

Pure: says what an injection means and who carries it out; whoever that is does it.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal, get_args

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire import keys

TargetType = Literal["process", "key", "joint", "bus", "simulator", "clock"]
Doer = Literal["supervisor", "process", "writer", "module", "samples", "driver", "host", "simulator"]
DOERS: Mapping[Doer, str] = {
    "supervisor": "the supervisor, `snakesim run`",
    "process": "the process itself",
    "writer": "whoever writes the key",
    "module": "the module",
    "samples": "the host, on what the sensors gave",
    "driver": "the driver",
    "host": "the host",
    "simulator": "the simulator",
}
RUN, HAL, CONTROL = "run", "hal", "control"
ROUTER = "router"  # that of a run with --with-router
FORM = "KIND:TARGET@START, KIND:TARGET@START-END, or either with =AMOUNT; in seconds, such as mute:joint_3@2-3.5"
LONGEST_TEXT = 200  # characters of one, as people write it
_text = re.compile(
    r"(?P<kind>[a-z_]+):(?P<target>[a-z0-9_/]+)@(?P<start>[0-9.]+)(-(?P<end>[0-9.]+))?(=(?P<amount>[-+0-9.e]+))?"
)
_numbered = re.compile(r"(?P<type>joint|bus)_(?P<number>[1-9][0-9]*)")


@dataclass(frozen=True)
class Amount:
    """How much of it: the number behind `=`."""

    about: str
    unit: str
    default: float
    low: float
    high: float


@dataclass(frozen=True)
class Kind:
    """One way to go wrong."""

    about: str
    by: tuple[Doer, ...]  # who carries it out; of two the first, where it can
    amount: Amount | None = None
    once: bool = False  # it happens, and has no end
    in_module: str = ""  # what it is in a module, where that is more than `about`


SHARE = Amount("share of the messages", "1", 1.0, 0.0, 1.0)

KINDS: Mapping[TargetType, Mapping[str, Kind]] = {
    "process": {
        "kill": Kind("SIGKILL: gone without a word", ("supervisor",), once=True),
        "stop": Kind("SIGTERM: ends in order", ("supervisor",), once=True),
        "freeze": Kind("SIGSTOP until the end: there, and silent", ("supervisor",)),
        "hang": Kind(
            "its interpreter is busy until the end: alive on the network, and does nothing",
            ("process",),
        ),
    },
    "key": {
        "drop": Kind("messages get lost", ("writer",), SHARE),
        "delay": Kind("messages come late", ("writer",), Amount("delay", "s", 0.05, 0.0, 10.0)),
        "duplicate": Kind("messages come twice", ("writer",), SHARE),
        "reorder": Kind("a message comes after the one that follows it", ("writer",), SHARE),
        "corrupt": Kind("bytes of messages are changed", ("writer",), SHARE),
        "flood": Kind("the newest message is sent over and over", ("writer",), Amount("rate", "1/s", 5000.0, 1.0, 1e5)),
    },
    "joint": {
        "mute": Kind("says nothing", ("module", "samples"), in_module="sends nothing; still hears, and follows"),
        "freeze": Kind(
            "repeats what it said last; its age grows",
            ("module", "samples"),
            in_module="its main loop hangs: repeats its last joint state, no heartbeat; passive after its watchdog",
        ),
        "wrong": Kind("its angle is off", ("samples",), Amount("offset", "rad", 0.5, -6.3, 6.3)),
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
            "its winding is heated to 5 °C above `stop_at_c`; kept there until the end, if one is given", ("module",)
        ),
        "leak": Kind("finds water inside", ("module",)),
        "babble": Kind("sends its heartbeat over and over, as often as the bus lets it", ("module",)),
        "undervoltage": Kind("its supply falls to 12 V", ("module",)),
    },
    "bus": {
        "cut": Kind("the interface goes down; it comes up again at the end", ("driver",)),
        "bus_off": Kind("the controller leaves the bus; it restarts at the end", ("driver",)),
        "error_passive": Kind("the controller has counted more than 127 errors", ("driver",), once=True),
        "overflow": Kind("received frames get lost", ("driver",), once=True),
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
    """One thing that goes wrong, for some time. Make it with `parse` or `checked`: those know what is allowed."""

    kind: str
    target: str
    start_s: float = 0.0  # of robot time since the first arming; for emulators, since they were started
    end_s: float = inf
    amount: float | None = None

    @property
    def target_type(self) -> TargetType:
        """What sort of thing it happens to."""
        return target_type(self.target)

    @property
    def about(self) -> Kind:
        """What it is."""
        return KINDS[self.target_type][self.kind]

    @property
    def number(self) -> int:
        """Of a joint or bus: its index from the tail, from 0."""
        match = _numbered.fullmatch(self.target)
        assert match is not None, f"{self.target} has no number"
        return int(match["number"]) - 1

    @property
    def part(self) -> str:
        """Who carries it out: the supervisor `run`, the host `hal`, or a service."""
        match self.about.by[0]:
            case "supervisor":
                return RUN
            case "process":
                return HAL if self.target == "host" else self.target
            case "writer":
                return writer_of(self.target)
            case _:
                return HAL

    def __str__(self) -> str:
        end = "" if self.end_s == inf else f"-{self.end_s:.12g}"
        amount = "" if self.amount is None else f"={self.amount:.12g}"
        return f"{self.kind}:{self.target}@{self.start_s:.12g}{end}{amount}"


def target_type(target: str) -> TargetType:
    """What sort of thing a name means."""
    numbered = _numbered.fullmatch(target)
    if numbered is not None:
        return "joint" if numbered["type"] == "joint" else "bus"
    if "/" in target:
        return "key"
    if target in ("simulator", "clock"):
        return target
    return "process"


OUTSIDE = ("operator", "preview")  # writers that are no part of a run


def writer_of(key: str) -> str:
    """The part that writes a key. Raises ConfigError for a key that no part of a run writes."""
    row = keys.row_at(key)
    if row is not None and row.kind in ("stream", "latched") and row.writer not in OUTSIDE:
        if row.key == keys.DONE_ALL:
            return keys.service_of(key)
        return {"HAL": HAL, "lease holder": CONTROL}.get(row.writer, row.writer)
    streams = [row.key for row in keys.SPACE if row.kind in ("stream", "latched") and row.writer not in OUTSIDE]
    raise ConfigError(f"{key!r}: no part of a run writes this key; those with a writer are {', '.join(streams)}")


def parse(text: str) -> Injection:
    """An injection from its text in a file. Raises ConfigError."""
    if len(text) > LONGEST_TEXT:
        raise ConfigError(f"fault {text[:40]!r}...: {len(text)} characters, at most {LONGEST_TEXT}: give {FORM}")
    match = _text.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"fault {text!r}: give {FORM}. Kinds: {kinds_in_short()}")
    try:
        start_s, end_s = float(match["start"]), float(match["end"] or inf)
        amount = None if match["amount"] is None else float(match["amount"])
    except ValueError:
        raise ConfigError(f"fault {text!r}: start, end and amount are numbers, such as @2.0-3.5=0.3") from None
    if end_s <= start_s:
        raise ConfigError(f"fault {text!r}: it ends at {end_s:g} s, which must be later than its start, {start_s:g} s")
    return checked(Injection(match["kind"], match["target"], start_s, end_s, amount), text)


def checked(injection: Injection, said: str | None = None) -> Injection:
    """The same, when it is allowed, with the default of its amount filled in. Raises ConfigError."""
    text = str(injection) if said is None else said
    sort = injection.target_type
    allowed = KINDS[sort]
    if injection.kind not in allowed:
        others = [other for other in get_args(TargetType) if injection.kind in KINDS[other]]
        also = ["processes" if other == "process" else f"{other}s" for other in others]
        hint = f"; {injection.kind} is for {' and '.join(also)}" if also else ""
        raise ConfigError(
            f"fault {text!r}: a {sort} such as {injection.target} knows no {injection.kind!r}, only "
            f"{', '.join(allowed)}{hint}"
        )
    kind = allowed[injection.kind]
    if sort == "key":
        writer_of(injection.target)
    if kind.amount is None:
        if injection.amount is not None:
            raise ConfigError(f"fault {text!r}: {injection.kind} takes no amount; leave out ={injection.amount:g}")
        return injection
    amount = kind.amount.default if injection.amount is None else injection.amount
    if not isfinite(amount) or not kind.amount.low <= amount <= kind.amount.high:
        raise ConfigError(
            f"fault {text!r}: {kind.amount.about} = {amount:g} must be from {kind.amount.low:g} to "
            f"{kind.amount.high:g} {kind.amount.unit}"
        )
    return Injection(injection.kind, injection.target, injection.start_s, injection.end_s, amount)


def check_targets(injections: Iterable[Injection], *, services: Iterable[str], joints: int, buses: int) -> None:
    """Whether a run has everything that is to go wrong. Raises ConfigError."""
    processes = [*services, "host", ROUTER]
    for injection in injections:
        sort = injection.target_type
        if sort in ("joint", "bus"):
            count = joints if sort == "joint" else buses
            if injection.number >= count:
                has = f"{sort}_1 to {sort}_{count}" if count else f"no {sort}"
                raise ConfigError(f"fault {str(injection)!r}: there is no {injection.target}; this run has {has}")
        elif sort == "process" and injection.target not in processes:
            raise ConfigError(
                f"fault {str(injection)!r}: there is no process {injection.target!r}; this run has "
                f"{', '.join(processes)}"
            )
        elif sort == "key" and injection.part not in processes and injection.part != HAL:
            raise ConfigError(
                f"fault {str(injection)!r}: {injection.part} writes {injection.target}, and this run does not start it"
            )
        elif injection.target == ROUTER and injection.part != RUN:
            can = [kind for kind, about in KINDS["process"].items() if "supervisor" in about.by]
            raise ConfigError(f"fault {str(injection)!r}: a router cannot {injection.kind}, only {', '.join(can)}")


@dataclass(frozen=True)
class Change:
    """An injection begins or ends."""

    at_s: float
    injection: Injection
    begins: bool


class Plan:
    """Injections in the order of time."""

    def __init__(self, injections: Iterable[Injection] = ()) -> None:
        self._changes: list[Change] = []
        for injection in injections:
            self.add(injection)

    def add(self, injection: Injection) -> None:
        """One more."""
        self._changes.append(Change(injection.start_s, injection, True))
        if injection.end_s != inf and not injection.about.once:
            self._changes.append(Change(injection.end_s, injection, False))
        self._changes.sort(key=lambda change: change.at_s)

    def next_s(self) -> float:
        """When the next one begins or ends; inf when none will."""
        return self._changes[0].at_s if self._changes else inf

    def until(self, now_s: float) -> list[Change]:
        """What begins or ends by now, each once."""
        due = [change for change in self._changes if change.at_s <= now_s]
        self._changes = self._changes[len(due) :]
        return due


def explain() -> str:
    """Every kind, for a command's help."""
    lines: list[str] = []
    for sort, kinds in KINDS.items():
        lines.append(f"{sort}:")
        for name, kind in kinds.items():
            amount = kind.amount
            much = ""
            if amount is not None:
                unit = "" if amount.unit == "1" else f" {amount.unit}"
                much = f"; amount: {amount.about}, {amount.default:g}{unit} if not given"
            lines.append(f"  {name:<14} {kind.about}{much}")
    return "\n".join(lines)


def kinds_in_short() -> str:
    """Every kind by what it happens to."""
    return "; ".join(f"{sort}: {', '.join(kinds)}" for sort, kinds in KINDS.items())
