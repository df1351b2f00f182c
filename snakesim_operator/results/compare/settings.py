"""Settings in which two runs differ: in a fair comparison, only the intended ones."""

from dataclasses import dataclass
from typing import Any

import msgspec

from snakesim_hal.model.files import leaves
from snakesim_operator.results.run_log import RunRecord

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
    """Return the values by which people tell runs apart, whether they differ or not."""
    rows = [("scenario", "name"), ("robot", "robot.name"), ("scene", "scene.name")]
    rows += [(key, key) for key in ("backend", "clock_mode", "rate_hz", "duration_s", "controller", "seed")]
    values_a = dict(leaves(msgspec.to_builtins(a.config)))
    values_b = dict(leaves(msgspec.to_builtins(b.config)))
    return [Setting(name, _value_text(values_a, key), _value_text(values_b, key)) for name, key in rows]


def differences(a: RunRecord, b: RunRecord) -> list[Setting]:
    """Return every value that differs: of the effective configuration, and of the robot's description.

    The description follows from the robot's file, so it is compared only if both runs have the same file.
    """
    sources = [("", _configured(a), _configured(b))]
    if a.config.robot == b.config.robot:
        sources.append(("description.", _described(a), _described(b)))
    settings: list[Setting] = []
    for prefix, values_a, values_b in sources:
        for key in dict.fromkeys([*values_a, *values_b]):
            is_in_both = key in values_a and key in values_b
            if not is_in_both or values_a[key] != values_b[key]:
                settings.append(Setting(prefix + key, _value_text(values_a, key), _value_text(values_b, key)))
    return settings


def drive_identities(a: RunRecord, b: RunRecord) -> dict[str, dict[str, dict[str, str]]]:
    """Return serial number and firmware version of each drive in which the runs differ: joint -> run -> field."""
    differing: dict[str, dict[str, dict[str, str]]] = {}
    for joint_a, joint_b in zip(a.description.joints, b.description.joints, strict=True):
        identity_a = {field: str(getattr(joint_a, field)) for field in DRIVE_IDENTITY}
        identity_b = {field: str(getattr(joint_b, field)) for field in DRIVE_IDENTITY}
        if identity_a != identity_b:
            differing[joint_a.name] = {"a": identity_a, "b": identity_b}
    return differing


def drives_in_words(a: RunRecord, b: RunRecord) -> str:
    """Return one sentence for all drives; empty if they are the same ones with the same firmware."""
    differing = drive_identities(a, b).values()
    if not differing:
        return ""
    total = len(a.description.joints)
    known_count = {"A": _count_known_drives(a), "B": _count_known_drives(b)}
    silent = [run for run, count in known_count.items() if count == 0]
    if silent:
        other = "B" if silent[0] == "A" else "A"
        return (
            f"drives: {silent[0]} reports no serial numbers and no firmware versions, {other} those of "
            f"{known_count[other]} of {total} joints"
        )
    serials = sum(both["a"]["serial"] != both["b"]["serial"] for both in differing)
    versions = sum(both["a"]["firmware"] != both["b"]["firmware"] for both in differing)
    return f"drives: another serial number at {serials} of {total} joints, another firmware version at {versions}"


def _count_known_drives(record: RunRecord) -> int:
    return sum(any(getattr(joint, field) for field in DRIVE_IDENTITY) for joint in record.description.joints)


def _configured(record: RunRecord) -> dict[str, Any]:
    """Return the values of the configuration, without empty sections."""
    return {key: value for key, value in leaves(msgspec.to_builtins(record.config)) if value != {}}


def _described(record: RunRecord) -> dict[str, Any]:
    """Return the values of the description. Sensors are named by their keys, as backends order them differently."""
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
