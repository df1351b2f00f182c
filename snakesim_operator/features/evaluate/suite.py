"""Reads the suite file: settings that a controller is tried in, each on many fields.

    scenario = "field"                              # what all cases begin with
    fields = 20                                     # without --fields
    controllers = ["obstacle_triplet"]              # without --controllers
    give_up_s = 12                                  # robot time without 3 cm of advance that ends a run
    limit_s = 1800                                  # wall time of one run, after which it counts as an error

    [set]                                           # in every case; any value, as with --set
    duration_s = 45

    [vary]                                          # every combination is a row of the table
    "scene.random_field.0.density_per_m2" = [8, 12]
    "scene.ground.friction" = "0.05:0.4:3"          # from, to, how many

    [[row]]                                         # or rows by name; with [vary], each in every combination
    name = "no pose sensor"
    set.robot.safety.action = "hold"
    unset = ["robot.sensors.pose"]                  # what the file may leave out, left out
    without = ["scene.ground.friction"]             # do not randomize these

    [[randomize]]                                   # in every case, evenly between two numbers, one value a field:
    set = ["scene.ground.friction"]                 # the same for every row and controller, and for all keys listed
    low = 0.1
    high = 0.4

A field is a number: the run's seed, and that of every random field in the scene.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import (
    ConfigTable,
    FileStruct,
    decode_table,
    read_table,
    resolve_file_path,
)
from snakesim_hal.model.scenario import (
    KeyOverride,
    RunConfig,
    compose_config_table,
    encode_config,
    validate_start_pose,
)
from snakesim_hal.model.scene_file.randomization import Randomization
from snakesim_hal.model.textfiles import parse_toml
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_operator.features.evaluate.case import EvaluationCase, make_case_id

MAX_CASES = 200_000
Count = Annotated[int, Meta(ge=1, le=100_000)]


class SuiteRow(FileStruct, frozen=True, kw_only=True):
    """A setting with a name: `[[row]]`."""

    name: Annotated[str, Meta(min_length=1, max_length=80)]
    """Name of the row in the table of results."""

    set: dict[str, Any] = {}
    """Values that this row sets, as with `--set`, over those of the suite."""

    unset: list[str] = []
    """Optional keys that this row removes, such as `robot.sensors.pose`."""

    without: list[str] = []
    """Keys that no [[randomize]] of the suite sets in this row."""


class EvaluationSuite(FileStruct, frozen=True, kw_only=True):
    """A whole suite file."""

    title: str = ""
    """Description in one line, which lists of suites show."""

    scenario: Annotated[str, Meta(min_length=1)]
    """Scenario that all cases begin with: the name of a shipped one, or a path."""

    fields: Count = 20
    """Number of fields for each row and controller, unless `--fields` gives another. A field is the seed of a run and
    of its random scene.
    """

    controllers: list[str] = []
    """Controllers to try, unless `--controllers` gives others. Empty: that of the scenario."""

    give_up_s: Annotated[float, Meta(gt=0, le=100_000, extra_json_schema={"unit": "s"})] = 12.0
    """Robot time without 3 cm of advance after which a run is ended as stuck."""

    limit_s: Annotated[float, Meta(gt=0, le=100_000, extra_json_schema={"unit": "s"})] = 1800.0
    """Wall time of one run after which it is stopped, and counts as an error."""

    set: dict[str, Any] = {}
    """Values that every row sets, as with `--set`."""

    unset: list[str] = []
    """Optional keys that every row removes."""

    vary: dict[str, list[Any] | str] = {}
    """For each key its values, as a list or as "LOW:HIGH:COUNT". Every combination of the values is a row."""

    row: list[SuiteRow] = []
    """Rows with a name, each an entry `[[row]]`, combined with every combination of `vary`. Empty: only these
    combinations.
    """

    randomize: list[Randomization] = []
    """Random values, each an entry `[[randomize]]`. A value is the same for every row and controller of one field."""

    fresh: bool = False
    """True: every evaluation has new fields, unless `--seed` gives the first one. False: fields begin at the same
    number.
    """


@dataclass(frozen=True)
class SuiteSetting:
    """One row of the table: its name, and the values that it sets."""

    name: str
    overrides: list[KeyOverride]
    value: float | None = None  # of what is varied, if that is one number
    randomizations: Sequence[Randomization] = ()


def read_suite(name: str) -> tuple[EvaluationSuite, str]:
    """Return a shipped suite or a suite file, and its path. Raises ConfigError."""
    path = resolve_file_path(name, "suites")
    return decode_table(read_table(path), EvaluationSuite), str(path)


def set_suite_values(suite: EvaluationSuite, values: dict[str, Any]) -> EvaluationSuite:
    """Return the suite with these keys set in every row, over what suite and row set."""
    rows = [msgspec.structs.replace(row, set={**row.set, **values}) for row in suite.row]
    return msgspec.structs.replace(suite, set={**suite.set, **values}, row=rows)


def select_cases_of_rows(
    cases: Sequence[EvaluationCase], rows: Sequence[int], source: str
) -> list[EvaluationCase]:
    """Return the cases of some rows, by number; all cases without a row. Raises ConfigError for a missing row."""
    known = {case.row for case in cases}
    for row in rows:
        if row not in known:
            raise ConfigError(
                f"--rows {row}: {source} has rows 1 to {cases[-1].row}",
                code="command/invalid-option",
            )
    if not rows:
        return list(cases)
    return [case for case in cases if case.row in rows]


def make_suite_settings(suite: EvaluationSuite, source: str) -> list[SuiteSetting]:
    """Make the rows of the table of results, each with the values that it sets in the scenario.

    Each named row of the suite is combined with each combination of the varied values.

    Args:
        suite: The suite.
        source: Path of the suite file or name of the command, for error messages.

    Raises:
        ConfigError: A value is invalid, or two rows have the same name.
    """
    common_overrides = list(_flatten_overrides(suite.set, f"{source}: [set]"))
    common_overrides += [KeyOverride(key, None, f"{source}: `unset`") for key in suite.unset]
    values_by_key = {key: _list_values(key, values, source) for key, values in suite.vary.items()}
    label_by_key = _shorten_keys(list(values_by_key))
    settings: list[SuiteSetting] = []
    for row in suite.row or [SuiteRow(name="")]:
        context = f"{source}: row {row.name!r}" if row.name else source
        row_overrides = list(_flatten_overrides(row.set, context))
        row_overrides += [KeyOverride(key, None, context) for key in row.unset]
        randomizations = _select_randomizations(suite, row.without, context)
        for combination in itertools.product(*values_by_key.values()):
            name_parts = [row.name] if row.name else []
            varied_overrides: list[KeyOverride] = []
            for key, value in zip(values_by_key, combination, strict=True):
                name_parts.append(f"{label_by_key[key]} {_format_short_value(value)}")
                varied_overrides.append(KeyOverride(key, value, f"{source}: [vary]"))
            name = ", ".join(name_parts) or "as it is"
            # The place of the row on the horizontal axis, if a single number is varied.
            varied_number = None
            if len(combination) == 1 and not row.name and _is_number(combination[0]):
                varied_number = combination[0]
            overrides = [*common_overrides, *row_overrides, *varied_overrides]
            settings.append(SuiteSetting(name, overrides, varied_number, randomizations))
    _validate_unique_names(settings, source)
    return settings


def _validate_unique_names(settings: Sequence[SuiteSetting], source: str) -> None:
    counts = Counter(setting.name for setting in settings)
    repeated = [name for name, count in counts.items() if count > 1]
    if repeated:
        raise ConfigError(
            f"{source}: two rows are called {min(repeated)!r}; rename one",
            code="config/duplicate-name",
        )


def make_cases(
    suite: EvaluationSuite,
    source: str,
    controllers: Sequence[str],
    field_count: int,
    first_field: int,
) -> list[EvaluationCase]:
    """Make every case of a suite in the order of the table, each with its whole configuration.

    The values that the suite sets are checked here on the first field of each row. A later field that cannot be laid
    out is named in its result.

    Args:
        suite: The suite.
        source: Path of the suite file or name of the command, for error messages.
        controllers: Names of the controllers to try; that of the scenario if empty.
        field_count: Number of fields for each row and controller. A field is a seed, and the random scene made from it.
        first_field: Number of the first field; each following field has the next number.

    Raises:
        ConfigError: The suite is invalid, or has too many cases.
    """
    settings = make_suite_settings(suite, source)
    case_count = len(settings) * len(controllers or [""]) * field_count
    if case_count > MAX_CASES:
        raise ConfigError(
            f"{source}: {case_count} cases; at most {MAX_CASES} are allowed",
            code="command/invalid-option",
        )
    cases: list[EvaluationCase] = []
    for row_number, setting in enumerate(settings, 1):
        for controller in controllers or [None]:
            table = _compose_scenario(suite, setting, controller)
            for field in range(first_field, first_field + field_count):
                config = _configure_field(table, field, setting.randomizations)
                if field == first_field:
                    _validate_config(
                        config, table, f"{source}, row {row_number} ({setting.name}), field {field}"
                    )
                cases.append(
                    EvaluationCase(
                        id=make_case_id(config, suite.give_up_s),
                        row=row_number,
                        setting=setting.name,
                        controller=config.commander_name,
                        field=field,
                        config=encode_config(config),
                        stall_timeout_s=suite.give_up_s,
                        timeout_s=suite.limit_s,
                        value=setting.value,
                    )
                )
    return cases


def _compose_scenario(
    suite: EvaluationSuite, setting: SuiteSetting, controller: str | None
) -> ConfigTable:
    """Return the scenario with the values of a setting, and with another controller unless `controller` is None."""
    overrides = [KeyOverride("clock_mode", "lockstep", "--clock-mode lockstep")]
    if controller:
        overrides.append(KeyOverride("controller", controller, f"--controllers {controller}"))
    return compose_config_table(suite.scenario, [*overrides, *setting.overrides])


def parse_vary(text: str) -> tuple[str, list[Any] | str]:
    """Return key and values of `--vary key=low:high:count` or `key=[a, b, c]`. Raises ConfigError."""
    key, equals, values = (part.strip() for part in text.partition("="))
    if not (key and equals and values):
        raise ConfigError(
            f"--vary {shorten(text)}: give key=low:high:count, such as control.look_ahead_m=0.05:0.2:4",
            code="command/invalid-option",
        )
    if not values.startswith("["):
        return key, values
    try:
        return key, parse_toml(f"value = {values}", "--vary")["value"]
    except ConfigError:
        raise ConfigError(
            f"--vary {shorten(text)}: {shorten(values)} is no list; write it as in TOML, [1, 2]",
            code="command/invalid-option",
        ) from None


def _validate_config(config: RunConfig, table: ConfigTable, context: str) -> None:
    """Raise a ConfigError that names the place if a configuration cannot be run."""
    try:
        validate_start_pose(config)
        validate_and_complete_config(config, table)
    except ConfigError as error:
        raise ConfigError(f"{context}: {error}", code=error.code) from None


def list_seed_keys(table: ConfigTable) -> list[str]:
    """Return the keys that are set to a field's number: the run's seed, and that of every random field."""
    scene = table.values.get("scene")
    random_fields = scene.get("random_field") if isinstance(scene, dict) else None
    count = len(random_fields) if isinstance(random_fields, list) else 0
    return ["seed", *(f"scene.random_field.{i}.seed" for i in range(count))]


def _configure_field(
    table: ConfigTable, field: int, randomizations: Sequence[Randomization]
) -> RunConfig:
    """Return the configuration of one field, with the values that are drawn for it."""
    for key in list_seed_keys(table):
        table.set_value(key, field, "--seed")
    for randomization in randomizations:
        for override in randomization.sample_overrides(field):
            table.set_value(override.key, override.value, override.flag)
    return decode_table(table, RunConfig)


def _select_randomizations(
    suite: EvaluationSuite, excluded_keys: Sequence[str], context: str
) -> list[Randomization]:
    """Return the suite's randomizations without the keys that a row leaves out.

    Args:
        suite: The suite with its randomizations.
        excluded_keys: Keys that the row does not randomize.
        context: Name of the row, for the error message.

    Raises:
        ConfigError: The row leaves out a key that is not randomized.
    """
    randomized_keys = {key for randomization in suite.randomize for key in randomization.set}
    for key in excluded_keys:
        if key not in randomized_keys:
            raise ConfigError(
                f"{context}: `without` names {key!r}, which no [[randomize]] sets",
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
