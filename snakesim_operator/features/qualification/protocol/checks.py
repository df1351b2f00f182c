"""Decides from measured values whether they confirm or refute a criterion. Pure."""

import math
from collections.abc import Iterable
from typing import Literal

import msgspec

Verdict = Literal["confirmed", "refuted", "unknown"]
Source = Literal[
    "drive log",  # the drive's own log, with its times
    "drive status",  # what the drive reports to a second program on its bus
    "host",  # what the HAL host publishes
    "operator",  # what the person at the bench has seen
]


class Check(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One value, and the bounds within which it confirms the criterion of its step."""

    name: str
    """What was measured."""

    value: float | str | None
    """The value. None: it could not be measured."""

    unit: str = "1"
    """Unit of the value and of its bounds. "1": it has no unit."""

    minimum: float | None = None
    """Lowest value that confirms. None: there is no such bound."""

    maximum: float | None = None
    """Highest value that confirms. None: there is no such bound."""

    equals: str | None = None
    """The only text that confirms. None: any text does, unless it is empty."""

    source: Source
    """Where the value comes from."""

    claims: tuple[str, ...] = ()
    """Ids of the claims in the documentation that this value tests."""

    note: str = ""
    """What limits the measurement."""


def judge_check(check: Check) -> Verdict:
    """Return whether a value confirms or refutes its criterion; a value that was not measured does neither."""
    match check.value:
        case None | "":
            return "unknown"
        case str() as text:
            return "confirmed" if check.equals in (None, text) else "refuted"
        case number:
            return _judge_number(number, check)


def _judge_number(number: float, check: Check) -> Verdict:
    if not math.isfinite(number):
        return "unknown"
    is_too_low = check.minimum is not None and number < check.minimum
    is_too_high = check.maximum is not None and number > check.maximum
    return "refuted" if is_too_low or is_too_high else "confirmed"


def combine_verdicts(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the verdict of several: one that refutes is enough, and all must confirm. None at all is unknown."""
    seen = set(verdicts)
    if "refuted" in seen:
        return "refuted"
    if seen == {"confirmed"}:
        return "confirmed"
    return "unknown"


def describe_check(check: Check) -> str:
    """Return a line such as "torque off after 0.104 s, at most 0.19 s (drive log)"."""
    unit = "" if check.unit == "1" else f" {check.unit}"
    match check.value:
        case None | "":
            value = "not measured"
        case str() as text:
            value = text
        case number:
            value = f"{number:.4g}{unit}"
    bounds: list[str] = []
    if check.minimum is not None:
        bounds.append(f"at least {check.minimum:.4g}{unit}")
    if check.maximum is not None:
        bounds.append(f"at most {check.maximum:.4g}{unit}")
    if check.equals is not None:
        bounds.append(f"must be {check.equals}")
    bounds.append(check.source)
    line = f"{check.name}: {value} ({', '.join(bounds)})"
    return f"{line}. {check.note}" if check.note else line
