"""Settings in which two runs differ: in a fair comparison, only the intended ones."""

from dataclasses import dataclass
from typing import Any

import msgspec

from snakesim_hal.model.files import leaves
from snakesim_operator.results.record import RunRecord

UNSET = "not set"
# Of the description: what the configuration has already, and what is another in every run.
FOLLOWS = ("config_hash", "robot", "backend", "simulated_time", "period_ns", "lease_ns", "host", "proof")
DRIVE_IDENTITY = ("serial", "firmware")  # of each joint's drive: which one it is, and no setting


@dataclass(frozen=True)
class Setting:
    """One value, in either run; text, as it would stand in a file."""

    key: str  # dotted
    a: str
    b: str


def identity(a: RunRecord, b: RunRecord) -> list[Setting]:
    """What was compared: the values by which people tell runs apart, whether they differ or not."""
    rows = [("scenario", "name"), ("robot", "robot.name"), ("scene", "scene.name")]
    rows += [(key, key) for key in ("backend", "clock_mode", "rate_hz", "duration_s", "controller", "seed")]
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


def drive_identities(a: RunRecord, b: RunRecord) -> dict[str, dict[str, dict[str, str]]]:
    """Returns serial number and firmware version of each drive in which the runs differ: joint -> run -> field."""
    found: dict[str, dict[str, dict[str, str]]] = {}
    for of_a, of_b in zip(a.description.joints, b.description.joints, strict=True):
        both = {
            run: {field: str(getattr(joint, field)) for field in DRIVE_IDENTITY}
            for run, joint in (("a", of_a), ("b", of_b))
        }
        if both["a"] != both["b"]:
            found[of_a.name] = both
    return found


def drives_in_words(a: RunRecord, b: RunRecord) -> str:
    """Returns one sentence for all drives; empty when they are the same ones with the same firmware."""
    differing = drive_identities(a, b).values()
    if not differing:
        return ""
    total = len(a.description.joints)
    told = {"A": _drives_that_tell(a), "B": _drives_that_tell(b)}
    silent = [run for run, count in told.items() if count == 0]
    if silent:
        other = "B" if silent[0] == "A" else "A"
        return (
            f"drives: {silent[0]} tells no serial numbers and no firmware versions, {other} those of {told[other]} of "
            f"{total} joints"
        )
    serials = sum(both["a"]["serial"] != both["b"]["serial"] for both in differing)
    versions = sum(both["a"]["firmware"] != both["b"]["firmware"] for both in differing)
    return f"drives: another serial number at {serials} of {total} joints, another firmware version at {versions}"


def _drives_that_tell(record: RunRecord) -> int:
    return sum(any(getattr(joint, field) for field in DRIVE_IDENTITY) for joint in record.description.joints)


def _configured(record: RunRecord) -> dict[str, Any]:
    """An empty section says nothing, so it is left out."""
    return {key: value for key, value in leaves(msgspec.to_builtins(record.config)) if value != {}}


def _described(record: RunRecord) -> dict[str, Any]:
    """Sensors are named by their keys, because each backend lists them in its own order."""
    fields = msgspec.to_builtins(record.description)
    fields["sensors"] = {sensor.pop("key"): sensor for sensor in fields["sensors"]}
    for joint in fields["joints"]:
        for field in DRIVE_IDENTITY:
            joint.pop(field, None)
    return dict(leaves({key: value for key, value in fields.items() if key not in FOLLOWS}))


def _value_text(values: dict[str, Any], key: str) -> str:
    if key not in values:
        return UNSET
    value = values[key]
    return value if isinstance(value, str) and value else msgspec.json.encode(value).decode()
