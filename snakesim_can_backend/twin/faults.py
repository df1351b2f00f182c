"""What can go wrong with a module, on request: `mute:joint_3@2.0-3.5` is a module that says nothing for 1.5 s."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

from snakesim_hal.errors import ConfigError

Kind = Literal[
    "mute",
    "freeze",
    "reboot",
    "counter",
    "checksum",
    "duplicate",
    "overheat",
    "leak",
    "babble",
    "undervoltage",
]

ABOUT: dict[Kind, str] = {
    "mute": "sends nothing; still hears, and follows",
    "freeze": "its main loop hangs: repeats its last joint state, no heartbeat; passive after the watchdog's time",
    "reboot": "restarts, once",
    "counter": "joint states with a wrong count",
    "checksum": "joint states with a wrong checksum",
    "duplicate": "a second module with the same node id and another serial is on the bus",
    "overheat": "its winding is heated to 110 °C; kept there until the end, if one is given",
    "leak": "finds water inside",
    "babble": "sends its heartbeat over and over, as often as the bus lets it",
    "undervoltage": "its supply falls to 12 V",
}
ONCE: frozenset[Kind] = frozenset(("reboot",))
FORM = "KIND:JOINT@START or KIND:JOINT@START-END, in seconds, such as mute:joint_3@2.0 or leak:joint_1@1-4"
_text = re.compile(r"(?P<kind>[a-z_]+):joint_(?P<joint>[0-9]+)@(?P<start>[0-9.]+)(?:-(?P<end>[0-9.]+))?")
_typed = re.compile(r"(?P<kind>[a-z_]+)[ :]+joint_(?P<joint>[0-9]+)(?: +(?P<off>off))?")


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong, for some time."""

    kind: Kind
    joint: int  # 0 at the tail
    start_s: float  # since the twins were started
    end_s: float = inf

    def __str__(self) -> str:
        end = "" if self.end_s == inf else f"-{self.end_s:g}"
        return f"{self.kind}:joint_{self.joint + 1}@{self.start_s:g}{end}"


@dataclass(frozen=True)
class Change:
    """A fault begins or ends."""

    at_us: float
    fault: Fault
    begins: bool


class Plan:
    """Every fault of a run, in the order of time."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        self._changes: list[Change] = []
        for fault in faults:
            self.add(fault)

    def add(self, fault: Fault) -> None:
        """One more."""
        self._changes.append(Change(fault.start_s * 1e6, fault, True))
        if fault.end_s != inf and fault.kind not in ONCE:
            self._changes.append(Change(fault.end_s * 1e6, fault, False))
        self._changes.sort(key=lambda change: change.at_us)

    def next_us(self) -> float:
        """When the next one begins or ends; inf when none will."""
        return self._changes[0].at_us if self._changes else inf

    def until(self, now_us: float) -> list[Change]:
        """What begins or ends by now, each once."""
        due = [change for change in self._changes if change.at_us <= now_us]
        self._changes = self._changes[len(due) :]
        return due


def parse(text: str, joints: int) -> Fault:
    """A fault from its text. Raises ConfigError."""
    match = _text.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"fault {text!r}: give {FORM}. Kinds: {', '.join(get_args(Kind))}")
    try:
        start_s, end_s = float(match["start"]), float(match["end"] or inf)
    except ValueError:
        raise ConfigError(f"fault {text!r}: start and end are seconds, such as @2.0-3.5") from None
    if end_s <= start_s:
        raise ConfigError(f"fault {text!r}: it ends at {end_s:g} s, which must be later than its start, {start_s:g} s")
    return Fault(_kind(match["kind"], text), _joint(int(match["joint"]), joints, text), start_s, end_s)


def parse_typed(text: str, joints: int, now_s: float) -> tuple[Fault, bool]:
    """A fault as typed in a terminal, `mute joint_3 off`, and whether it begins. Raises ConfigError."""
    match = _typed.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"{text.strip()!r}: type KIND joint_N, and later KIND joint_N off. Kinds: {_kinds()}")
    fault = Fault(_kind(match["kind"], text), _joint(int(match["joint"]), joints, text), now_s)
    return fault, match["off"] is None


def explain() -> str:
    """Every kind, for a command's help."""
    return "\n".join(f"  {kind:<13} {about}" for kind, about in ABOUT.items())


def _kinds() -> str:
    return ", ".join(get_args(Kind))


def _kind(name: str, text: str) -> Kind:
    for kind in ABOUT:
        if kind == name:
            return kind
    raise ConfigError(f"fault {text!r}: there is no kind {name!r}; allowed are {_kinds()}")


def _joint(number: int, joints: int, text: str) -> int:
    if not 1 <= number <= joints:
        raise ConfigError(f"fault {text!r}: there is no joint_{number}; this robot has joint_1 to joint_{joints}")
    return number - 1
