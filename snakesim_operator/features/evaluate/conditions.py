"""The conditions of a suite, and the values that each of them sets in the scenario."""

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.scenario import KeyOverride
from snakesim_hal.model.scene_file.randomization import Randomization
from snakesim_operator.features.evaluate.suite import ConditionEntry, EvaluationSuite

# Name of a condition that changes nothing by name, and varies nothing.
UNCHANGED_NAME = "as it is"


@dataclass(frozen=True)
class Condition:
    """Values of the configuration with which every controller is tried."""

    name: str
    overrides: list[KeyOverride]
    # None if the condition differs from the others in more than a single number.
    varied_number: float | None = None
    randomizations: Sequence[Randomization] = ()


def make_conditions(suite: EvaluationSuite, source: str) -> list[Condition]:
    """Make the conditions of a suite, each with the values that it sets in the scenario.

    Each named condition of the suite is combined with each combination of the varied values.

    Args:
        suite: The suite.
        source: Path of the suite file or name of the command, for error messages.

    Raises:
        ConfigError: A value is invalid, or two conditions have the same name.
    """
    common_overrides = list(_flatten_overrides(suite.set, f"{source}: [set]"))
    common_overrides += [KeyOverride(key, None, f"{source}: `unset`") for key in suite.unset]
    values_by_key = {key: _list_values(key, values, source) for key, values in suite.vary.items()}
    conditions: list[Condition] = []
    for entry in suite.condition or [ConditionEntry(name="")]:
        context = f"{source}: condition {entry.name!r}" if entry.name else source
        entry_overrides = list(_flatten_overrides(entry.set, context))
        entry_overrides += [KeyOverride(key, None, context) for key in entry.unset]
        randomizations = _select_randomizations(suite, entry.not_randomized, context)
        for combination in itertools.product(*values_by_key.values()):
            value_by_key = dict(zip(values_by_key, combination, strict=True))
            varied_overrides = [
                KeyOverride(key, value, f"{source}: [vary]") for key, value in value_by_key.items()
            ]
            condition = Condition(
                name=_make_name(entry.name, value_by_key),
                overrides=[*common_overrides, *entry_overrides, *varied_overrides],
                varied_number=_find_varied_number(entry.name, combination),
                randomizations=randomizations,
            )
            conditions.append(condition)
    _validate_unique_names(conditions, source)
    return conditions


def _make_name(entry_name: str, value_by_key: Mapping[str, Any]) -> str:
    """Return the name of a condition: that of its entry in the suite, and each varied value."""
    label_by_key = _shorten_keys(list(value_by_key))
    parts = [entry_name] if entry_name else []
    parts += [
        f"{label_by_key[key]} {_format_short_value(value)}" for key, value in value_by_key.items()
    ]
    return ", ".join(parts) or UNCHANGED_NAME


def _find_varied_number(entry_name: str, combination: Sequence[Any]) -> float | None:
    """Return the place of a condition on the horizontal axis, if the suite varies a single number."""
    if len(combination) == 1 and not entry_name and _is_number(combination[0]):
        return combination[0]
    return None


def _validate_unique_names(conditions: Sequence[Condition], source: str) -> None:
    counts = Counter(condition.name for condition in conditions)
    repeated = [name for name, count in counts.items() if count > 1]
    if repeated:
        raise ConfigError(
            f"{source}: two conditions are called {min(repeated)!r}; rename one",
            code="config/duplicate-name",
        )


def _select_randomizations(
    suite: EvaluationSuite, excluded_keys: Sequence[str], context: str
) -> list[Randomization]:
    """Return the suite's randomizations without the keys that a condition does not randomize.

    Args:
        suite: The suite with its randomizations.
        excluded_keys: Keys that the condition does not randomize.
        context: Name of the condition, for the error message.

    Raises:
        ConfigError: The condition excludes a key that is not randomized.
    """
    randomized_keys = {key for randomization in suite.randomize for key in randomization.set}
    for key in excluded_keys:
        if key not in randomized_keys:
            raise ConfigError(
                f"{context}: `not_randomized` names {key!r}, which no [[randomize]] sets",
                code="command/invalid-option",
            )
    randomizations: list[Randomization] = []
    for randomization in suite.randomize:
        remaining_keys = [key for key in randomization.set if key not in excluded_keys]
        if remaining_keys:
            randomizations.append(msgspec.structs.replace(randomization, set=remaining_keys))
    return randomizations


def _flatten_overrides(
    values: dict[str, Any], origin: str, prefix: str = ""
) -> Iterator[KeyOverride]:
    """Yield an override for each value; nested tables become dotted keys, and a list replaces the whole list."""
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from _flatten_overrides(value, origin, f"{prefix}{key}.")
        else:
            yield KeyOverride(prefix + key, value, origin)


def _list_values(key: str, values: list[Any] | str, source: str) -> list[Any]:
    """Return the values of a `[vary]` entry: those of the list, or evenly spaced ones. Raises ConfigError."""
    if isinstance(values, str):
        return parse_even_spacing(values, f"{source}: `vary.{key}`")
    if not values:
        raise ConfigError(
            f"{source}: `vary.{key}` is empty; give at least one value",
            code="command/invalid-option",
        )
    return values


def parse_even_spacing(values: str, context: str) -> list[float]:
    """Parse `low:high:count`, and return evenly spaced numbers with both ends.

    Args:
        values: The text to parse.
        context: Name of the key that the values are for, for the error message.

    Raises:
        ConfigError: The text has another form.
    """
    try:
        first_value, last_value, count = (float(part) for part in values.split(":"))
        is_finite = math.isfinite(first_value) and math.isfinite(last_value)
        is_a_count = count.is_integer() and 2 <= count <= 1000
        if not (is_finite and is_a_count):
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"{context} = {shorten(values)!r}: give low:high:count with a count of 2 to 1000, such as "
            "0.05:0.2:4, or a list",
            code="command/invalid-option",
        ) from None
    return [
        round(first_value + (last_value - first_value) * i / (count - 1), 12)
        for i in range(int(count))
    ]


def _shorten_keys(keys: list[str]) -> dict[str, str]:
    """Return the last part of each dotted key, or the whole key if two keys share the last part."""
    last_parts = [key.rpartition(".")[2] for key in keys]
    names: dict[str, str] = {}
    for key, last_part in zip(keys, last_parts, strict=True):
        is_unique = last_parts.count(last_part) == 1
        names[key] = last_part if is_unique else key
    return names


def _format_short_value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return shorten(str(value), 40)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
