"""The runs of one figure: which arguments name them, their labels, and which of them differ in the seed alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import iterate_leaves
from snakesim_operator.results.run_log import RunRecord

SEED_KEY = "seed"  # last part of each key that only decides random numbers
MAX_KEYS_IN_LABEL = 2


@dataclass(frozen=True)
class RunGroup:
    """Runs that are drawn as one: a single run, or runs that differ in their seeds alone."""

    label: str
    records: list[RunRecord]

    @property
    def end_s(self) -> float:
        """The last time that every run of the group has, since its first tick."""
        return min(float(record.time_s[-1] - record.time_s[0]) for record in self.records)


def split_runs_and_signals(arguments: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Split the arguments of the command line into paths of runs and names of signals.

    Every argument up to the last one that names a file or folder is a run. No signal has a slash in its name.

    Returns:
        The runs and the signals, each in their order.
    """
    run_count = 1
    for i, argument in enumerate(arguments):
        if "/" in argument or Path(argument).exists():
            run_count = i + 1
    return [Path(argument) for argument in arguments[:run_count]], list(arguments[run_count:])


def load_armed_runs(paths: Sequence[Path]) -> list[RunRecord]:
    """Load runs that were armed. Raises ConfigError for one that was not."""
    records: list[RunRecord] = []
    for path in paths:
        record = RunRecord.load(path)
        if not len(record.time_s):
            raise ConfigError(
                f"{path}: nothing was recorded in it; the robot was never armed",
                code="recording/never-armed",
            )
        records.append(record)
    return records


def make_single_run_groups(records: Sequence[RunRecord]) -> list[RunGroup]:
    """Return a group for each run, labeled with the name of its folder, or with its path if names are equal."""
    names = [record.path.name for record in records]
    if len(set(names)) < len(names):
        names = [str(record.path) for record in records]
    return [RunGroup(name, [record]) for name, record in zip(names, records, strict=True)]


def group_runs_by_configuration(records: Sequence[RunRecord]) -> list[RunGroup]:
    """Group runs whose configurations are equal except for their seeds, in the order of the first runs.

    Args:
        records: The runs.

    Returns:
        The groups, each with a label that names the settings in which it differs from the other groups.

    Raises:
        ConfigError: No two runs differ in their seeds alone, or the same run is given twice.
    """
    records_by_key: dict[str, list[RunRecord]] = {}
    settings_by_key: dict[str, dict[str, Any]] = {}
    for record in records:
        values = _read_settings(record)
        key = msgspec.json.encode(values, order="deterministic").decode()
        records_by_key.setdefault(key, []).append(record)
        settings_by_key[key] = values
    if all(len(members) == 1 for members in records_by_key.values()):
        raise ConfigError(
            f"--mean: no two of these {len(records)} runs differ in their seeds alone; give runs of one scenario with "
            "different --seed, or leave --mean out",
            code="command/invalid-option",
        )
    for members in records_by_key.values():
        _validate_seeds_differ(members)
    labels = _make_labels(list(settings_by_key.values()), list(records_by_key.values()))
    return [
        RunGroup(label, members)
        for label, members in zip(labels, records_by_key.values(), strict=True)
    ]


def _read_settings(record: RunRecord) -> dict[str, Any]:
    """Return the configuration of a run by dotted keys, without its seeds."""
    values = iterate_leaves(msgspec.to_builtins(record.config))
    return {key: value for key, value in values if key.rpartition(".")[2] != SEED_KEY}


def _validate_seeds_differ(members: Sequence[RunRecord]) -> None:
    """Raise ConfigError if two runs have one seed: they are the same run, and not independent."""
    folders: dict[str, Path] = {}
    for record in members:
        seeds = [
            value
            for key, value in iterate_leaves(msgspec.to_builtins(record.config))
            if key.rpartition(".")[2] == SEED_KEY
        ]
        first_folder = folders.setdefault(str(seeds), record.path)
        if first_folder is not record.path:
            raise ConfigError(
                f"--mean: {first_folder} and {record.path} have the same configuration and seed "
                f"{record.config.seed}, so they count as one run; leave one of them out",
                code="command/invalid-option",
            )


def _make_labels(
    settings: Sequence[dict[str, Any]], groups: Sequence[Sequence[RunRecord]]
) -> list[str]:
    """Return a label for each group: the settings in which the groups differ, and the number of runs."""
    keys = list(dict.fromkeys(key for values in settings for key in values))
    differing = [
        key for key in keys if any(values.get(key) != settings[0].get(key) for values in settings)
    ]
    labels: list[str] = []
    for values, members in zip(settings, groups, strict=True):
        names = [_describe_setting(key, values) for key in differing]
        if not names or len(names) > MAX_KEYS_IN_LABEL:
            names = [members[0].config.name if not names else members[0].path.name]
        count = f"mean of {len(members)} runs" if len(members) > 1 else "1 run"
        labels.append(f"{', '.join(names)} ({count})")
    return labels


def _describe_setting(key: str, values: dict[str, Any]) -> str:
    """Return a setting in a few words, by the last part of its key."""
    name = key.rpartition(".")[2]
    if key not in values:
        return f"{name} not set"
    value = values[key]
    if isinstance(value, float):
        return f"{name} {value:g}"
    return str(value) if isinstance(value, str) else f"{name} {value}"
