"""Finds the settings in which two runs differ. In a fair comparison these are only the intended ones."""

from dataclasses import dataclass
from typing import Any

import msgspec

from snakesim_hal.model.files import iterate_leaves
from snakesim_operator.results.run_log import RunRecord

UNSET_TEXT = "not set"
# Keys of the description that repeat the configuration, or that differ in every run.
IGNORED_DESCRIPTION_KEYS = (
    "config_hash",
    "robot",
    "backend",
    "simulated_time",
    "period_ns",
    "lease_ns",
    "host",
    "proof",
)
# Fields of a joint that identify its drive, and are not settings.
DRIVE_IDENTITY_FIELDS = "serial", "firmware"


@dataclass(frozen=True)
class SettingDifference:
    """The value of one setting in both runs, as text."""

    key: str  # dotted
    a: str
    b: str


def list_identifying_settings(a: RunRecord, b: RunRecord) -> list[SettingDifference]:
    """List the settings that identify a run for people, whether they differ or not."""
    rows = [("scenario", "name"), ("robot", "robot.name"), ("scene", "scene.name")]
    rows += [
        (key, key)
        for key in ("backend", "clock_mode", "rate_hz", "duration_s", "controller", "seed")
    ]
    values_a = dict(iterate_leaves(msgspec.to_builtins(a.config)))
    values_b = dict(iterate_leaves(msgspec.to_builtins(b.config)))
    return [
        SettingDifference(name, _format_value(values_a, key), _format_value(values_b, key))
        for name, key in rows
    ]


def find_differing_settings(a: RunRecord, b: RunRecord) -> list[SettingDifference]:
    """Find every value that differs: of the effective configuration, and of the description of the robot.

    The description follows from the robot file, so it is compared only if both runs have the same robot file.
    """
    sources = [("", _flatten_config(a), _flatten_config(b))]
    if a.config.robot == b.config.robot:
        sources.append(("description.", _flatten_description(a), _flatten_description(b)))
    settings: list[SettingDifference] = []
    for prefix, values_a, values_b in sources:
        for key in dict.fromkeys([*values_a, *values_b]):
            is_in_both = key in values_a and key in values_b
            if not is_in_both or values_a[key] != values_b[key]:
                settings.append(
                    SettingDifference(
                        prefix + key, _format_value(values_a, key), _format_value(values_b, key)
                    )
                )
    return settings


def find_drive_differences(a: RunRecord, b: RunRecord) -> dict[str, dict[str, dict[str, str]]]:
    """Find the drives whose serial number or firmware version differs.

    Returns:
        For each such joint by name, for "a" and "b", the fields DRIVE_IDENTITY_FIELDS by name.
    """
    differing: dict[str, dict[str, dict[str, str]]] = {}
    for joint_a, joint_b in zip(a.description.joints, b.description.joints, strict=True):
        identity_a = {field: str(getattr(joint_a, field)) for field in DRIVE_IDENTITY_FIELDS}
        identity_b = {field: str(getattr(joint_b, field)) for field in DRIVE_IDENTITY_FIELDS}
        if identity_a != identity_b:
            differing[joint_a.name] = {"a": identity_a, "b": identity_b}
    return differing


def describe_drive_differences(a: RunRecord, b: RunRecord) -> str:
    """Describe by one sentence how the drives differ; empty if all are the same, with the same firmware."""
    differing = find_drive_differences(a, b).values()
    if not differing:
        return ""
    total = len(a.description.joints)
    known_count = {"A": _count_known_drives(a), "B": _count_known_drives(b)}
    unreported_runs = [run for run, count in known_count.items() if count == 0]
    if unreported_runs:
        other_run = "B" if unreported_runs[0] == "A" else "A"
        return (
            f"drives: {unreported_runs[0]} reports no serial numbers and no firmware versions, {other_run} those of "
            f"{known_count[other_run]} of {total} joints"
        )
    serial_count = sum(
        identities["a"]["serial"] != identities["b"]["serial"] for identities in differing
    )
    version_count = sum(
        identities["a"]["firmware"] != identities["b"]["firmware"] for identities in differing
    )
    return (
        f"drives: another serial number at {serial_count} of {total} joints, another firmware version at "
        f"{version_count}"
    )


def _count_known_drives(record: RunRecord) -> int:
    """Count the joints whose drive reported a serial number or a firmware version."""
    return sum(
        any(getattr(joint, field) for field in DRIVE_IDENTITY_FIELDS)
        for joint in record.description.joints
    )


def _flatten_config(record: RunRecord) -> dict[str, Any]:
    """Return the values of the configuration by dotted key, without empty sections."""
    return {
        key: value
        for key, value in iterate_leaves(msgspec.to_builtins(record.config))
        if value != {}
    }


def _flatten_description(record: RunRecord) -> dict[str, Any]:
    """Return the values of the description by dotted key.

    Sensors are named by their keys instead of their indices, because backends order them differently.
    """
    fields = msgspec.to_builtins(record.description)
    fields["sensors"] = {sensor.pop("key"): sensor for sensor in fields["sensors"]}
    for joint in fields["joints"]:
        for field in DRIVE_IDENTITY_FIELDS:
            joint.pop(field, None)
    return dict(
        iterate_leaves(
            {key: value for key, value in fields.items() if key not in IGNORED_DESCRIPTION_KEYS}
        )
    )


def _format_value(values: dict[str, Any], key: str) -> str:
    """Format a value as in a configuration file; UNSET_TEXT if the key is missing."""
    if key not in values:
        return UNSET_TEXT
    value = values[key]
    return value if isinstance(value, str) and value else msgspec.json.encode(value).decode()
