"""`snakesim config SCENARIO --explain KEY`: what a key means, what it may be, and what it is in a scenario."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from snakesim_hal.base.errors import ConfigError, find_nearest_word, shorten
from snakesim_hal.base.terminal import align_columns, print_json, print_line
from snakesim_hal.model.fields.field_words import format_value
from snakesim_hal.model.scenario import CHOSEN_PREFIXES, LoadedScenario, RunConfig
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_operator.this_computer.scenario_keys import ScenarioKey, collect_keys

MAX_VALUE_CHARACTERS = 40  # of a value in the list of a table's keys
MAX_KEYS_TEXT_CHARACTERS = 400  # characters
COLUMNS = ("key", "value", "unit", "description")


def explain_key(scenario: LoadedScenario, requested_name: str, *, as_json: bool) -> int:
    """Print type, unit, range, default, meaning, value and origin of a key; for a table also one line for each key.

    Args:
        scenario: The checked scenario, with the origin of each value.
        requested_name: Dotted name of the key. `control.KEY` and `backend.KEY` refer to the chosen controller and
            backend.
        as_json: Whether to print JSON instead of text.

    Returns:
        0, the exit code of the command.

    Raises:
        ConfigError: The scenario is not valid, or there is no such key.
    """
    validate_and_complete_config(scenario.config, scenario.table, load_file_plugins=False)
    full_name = _expand_shorthand_key(scenario.config, requested_name)
    keys = collect_keys(scenario, include_section_of=full_name)
    if full_name not in keys:
        raise _make_unknown_key_error(keys, requested_name, full_name)
    key = keys[full_name]
    inner_keys = _find_inner_keys(keys, full_name)
    if as_json:
        print_json(_convert_to_json(key, inner_keys))
        return 0
    for line in _format_explanation(key, inner_keys):
        print_line(line)
    return 0


def _expand_shorthand_key(config: RunConfig, name: str) -> str:
    """Return the full name of a key: `control.KEY` and `backend.KEY` are in the sections of the chosen plugins."""
    control_prefix, backend_prefix = CHOSEN_PREFIXES
    if f"{name}." == control_prefix:
        return config.control_section
    if name.startswith(control_prefix):
        return f"{config.control_section}.{name.removeprefix(control_prefix)}"
    if name.startswith(backend_prefix):
        return f"{config.backend_section}.{name.removeprefix(backend_prefix)}"
    return name


def _find_inner_keys(keys: Mapping[str, ScenarioKey], table: str) -> list[ScenarioKey]:
    """Return the keys directly inside of a table."""
    prefix = f"{table}."
    return [
        key
        for name, key in keys.items()
        if name.startswith(prefix) and "." not in name.removeprefix(prefix)
    ]


def _make_unknown_key_error(
    keys: Mapping[str, ScenarioKey], requested_name: str, full_name: str
) -> ConfigError:
    """Make the error for a key that does not exist. Its text names a similar key, or all keys of the same table.

    Args:
        keys: All keys of the scenario by their dotted names.
        requested_name: Name of the key as the user typed it.
        full_name: Full name of the same key, with the section of the chosen controller or backend.
    """
    problem = f"--explain {shorten(requested_name)}: there is no such key"
    *parents, last_word = full_name.split(".")
    while parents and ".".join(parents) not in keys:
        parents.pop()
    table = ".".join(parents)  # the innermost table that exists; empty: the top of the scenario
    if table:
        siblings = _find_inner_keys(keys, table)
        nearest = _find_nearest_key(last_word, siblings)
    else:
        siblings = [key for key in keys.values() if "." not in key.name]
        nearest = None
    if nearest is None:
        nearest = _find_nearest_key(last_word, list(keys.values()))
    if nearest is None and not table:
        nearest = keys.get(find_nearest_word(full_name, keys) or "")
    if nearest is not None:
        return ConfigError(f"{problem}; did you mean `{nearest.name}`?")
    sibling_names = ", ".join(key.doc.name for key in siblings)
    context = f"`{table}` has" if table else "the tables and keys at the top are"
    return ConfigError(f"{problem}; {context} {shorten(sibling_names, MAX_KEYS_TEXT_CHARACTERS)}")


def _find_nearest_key(last_part: str, keys: Sequence[ScenarioKey]) -> ScenarioKey | None:
    """Return the key whose last part is most similar to a word; None if none is similar."""
    nearest = find_nearest_word(last_part, [key.doc.name for key in keys])
    return next((key for key in keys if key.doc.name == nearest), None)


def _convert_to_json(key: ScenarioKey, inner_keys: Sequence[ScenarioKey]) -> dict[str, Any]:
    described = _describe_as_json(key)
    if key.is_table:
        described["keys"] = {inner.doc.name: _describe_as_json(inner) for inner in inner_keys}
    return described


def _describe_as_json(key: ScenarioKey) -> dict[str, Any]:
    return {
        "key": key.name,
        "type": key.doc.type_words,
        "unit": key.doc.unit,
        "default": key.doc.default,
        "range": key.doc.range_words,
        "description": key.doc.description,
        "value": key.value,
        "origin": key.origin,
    }


def _format_explanation(key: ScenarioKey, inner_keys: Sequence[ScenarioKey]) -> Iterator[str]:
    """Yield the lines that explain a key."""
    yield key.name
    yield f"  {key.doc.description}"
    rows = _describe_table(key) if key.is_table else _describe_value(key)
    for name, text in rows.items():
        yield f"  {name:<8} {text}"
    if inner_keys:
        yield "keys"
        yield from (
            f"  {line}"
            for line in align_columns(COLUMNS, [_make_table_row(inner) for inner in inner_keys])
        )


def _describe_table(key: ScenarioKey) -> dict[str, str]:
    rows = {"type": key.doc.type_words}
    if key.doc.range_words:
        rows["range"] = key.doc.range_words
    return rows


def _describe_value(key: ScenarioKey) -> dict[str, str]:
    rows = {
        "type": key.doc.type_words,
        "unit": key.doc.unit or "none",
        "range": key.doc.range_words or "any",
        "default": "none, the key is required" if key.doc.default is None else key.doc.default,
    }
    if key.is_pattern:
        rows["value"] = "one for each entry"
    else:
        rows["value"] = format_value(key.value)
        rows["from"] = key.origin
    return rows


def _make_table_row(key: ScenarioKey) -> dict[str, str]:
    """Return one line of the keys of a table, by column."""
    value = "" if key.is_pattern or (key.is_table and key.value) else format_value(key.value)
    return {
        "key": key.doc.name,
        "value": shorten(value, MAX_VALUE_CHARACTERS),
        "unit": key.doc.unit,
        "description": key.doc.description,
    }
