"""Settings in which two runs differ: in a fair comparison, only the intended ones."""

from dataclasses import dataclass
from typing import Any

import msgspec

from snakesim_hal.model.files import leaves
from snakesim_operator.results.record import RunRecord

UNSET = "not set"
# Of the description: what the configuration has already, and what is another in every run.
FOLLOWS = ("config_hash", "robot", "backend", "period_ns", "lease_ns", "host", "proof")


@dataclass(frozen=True)
class Setting:
    """One value, in either run; text, as it would stand in a file."""

    key: str  # dotted
    a: str
    b: str


def identity(a: RunRecord, b: RunRecord) -> list[Setting]:
    """What was compared: the values by which people tell runs apart, whether they differ or not."""
    rows = [("scenario", "name"), ("robot", "robot.name"), ("scene", "scene.name")]
    rows += [(key, key) for key in ("backend", "pace", "rate_hz", "duration_s", "controller", "seed")]
    of_a, of_b = (dict(leaves(msgspec.to_builtins(record.config))) for record in (a, b))
    return [Setting(name, _value_text(of_a, key), _value_text(of_b, key)) for name, key in rows]


def differences(a: RunRecord, b: RunRecord) -> list[Setting]:
    """Every value that is not the same in both: of the effective configuration, and of the robot as described.

    The description follows from the robot's file, so it is shown only where one file was described in two ways.
    """
    found: list[Setting] = []
    sources = [("", _configured(a), _configured(b))]
    if a.config.robot == b.config.robot:
        sources.append(("description.", _described(a), _described(b)))
    for prefix, of_a, of_b in sources:
        for key in [*of_a, *(key for key in of_b if key not in of_a)]:
            if key not in of_a or key not in of_b or of_a[key] != of_b[key]:
                found.append(Setting(prefix + key, _value_text(of_a, key), _value_text(of_b, key)))
    return found


def _configured(record: RunRecord) -> dict[str, Any]:
    """An empty section says nothing, so it is left out."""
    return {key: value for key, value in leaves(msgspec.to_builtins(record.config)) if value != {}}


def _described(record: RunRecord) -> dict[str, Any]:
    fields = msgspec.to_builtins(record.description)
    return dict(leaves({key: value for key, value in fields.items() if key not in FOLLOWS}))


def _value_text(values: dict[str, Any], key: str) -> str:
    if key not in values:
        return UNSET
    value = values[key]
    return value if isinstance(value, str) and value else msgspec.json.encode(value).decode()
