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
from snakesim_hal.model.files import FileStruct, Table, decode, find_file, read_table
from snakesim_hal.model.randomization import Randomization
from snakesim_hal.model.scenario import Override, RunConfig, check, compose_table, encode_config
from snakesim_hal.model.textfiles import parse_toml
from snakesim_hal.programs.preflight import check_plugins
from snakesim_operator.features.evaluate.case import Case, case_id

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


class Suite(FileStruct, frozen=True, kw_only=True):
    """A whole suite file."""

    title: str = ""
    """Description in one line, which lists of suites show."""

    scenario: Annotated[str, Meta(min_length=1)]
    """Scenario that all cases begin with: the name of a shipped one, or a path."""

    fields: Count = 20
    """Number of fields for each row and controller, unless `--fields` gives another; a field is the seed of a run and
    of its random scene.
    """

    controllers: list[str] = []
    """Controllers to try, unless `--controllers` gives others; empty: that of the scenario."""

    give_up_s: Annotated[float, Meta(gt=0, le=100_000, extra_json_schema={"unit": "s"})] = 12.0
    """Robot time without 3 cm of advance after which a run is ended as stuck."""

    limit_s: Annotated[float, Meta(gt=0, le=100_000, extra_json_schema={"unit": "s"})] = 1800.0
    """Wall time of one run after which it is stopped, and counts as an error."""

    set: dict[str, Any] = {}
    """Values that every row sets, as with `--set`."""

    unset: list[str] = []
    """Optional keys that every row removes."""

    vary: dict[str, list[Any] | str] = {}
    """For each key its values, as a list or as "LOW:HIGH:COUNT"; every combination of the values is a row."""

    row: list[SuiteRow] = []
    """Rows with a name, each an entry `[[row]]`, combined with every combination of `vary`; empty: only these
    combinations.
    """

    randomize: list[Randomization] = []
    """Random values, each an entry `[[randomize]]`; a value is the same for every row and controller of one field."""

    fresh: bool = False
    """True: every evaluation has new fields, unless `--seed` gives the first one; false: fields begin at the same
    number.
    """


@dataclass(frozen=True)
class SuiteSetting:
    """One row of the table: its name, and the values that it sets."""

    name: str
    overrides: list[Override]
    value: float | None = None  # of what is varied, if that is one number
    randomizations: Sequence[Randomization] = ()


def read_suite(name: str) -> tuple[Suite, str]:
    """Return a shipped suite or a suite file, and its path. Raises ConfigError."""
    path = find_file(name, "suites")
    return decode(read_table(path), Suite), str(path)


def override_suite(suite: Suite, values: dict[str, Any]) -> Suite:
    """Return the suite with these keys set in every row, over what suite and row set."""
    rows = [msgspec.structs.replace(row, set={**row.set, **values}) for row in suite.row]
    return msgspec.structs.replace(suite, set={**suite.set, **values}, row=rows)


def select_rows(cases: Sequence[Case], rows: Sequence[int], source: str) -> list[Case]:
    """Return the cases of some rows, by number; all cases without a row. Raises ConfigError for a missing row."""
    known = {case.row for case in cases}
    for row in rows:
        if row not in known:
            raise ConfigError(f"--rows {row}: {source} has rows 1 to {cases[-1].row}", code="command/invalid-option")
    if not rows:
        return list(cases)
    return [case for case in cases if case.row in rows]


def make_settings(suite: Suite, source: str) -> list[SuiteSetting]:
    """Return the rows of the table of results, each with the values that it sets in the scenario.

    Each named row of the suite is combined with each combination of the varied values.

    Args:
        suite: The suite.
        source: Where it came from, for messages.

    Raises:
        ConfigError: A value is invalid, or two rows have the same name.
    """
    common = list(_flatten_overrides(suite.set, f"{source}: [set]"))
    common += [Override(key, None, f"{source}: `unset`") for key in suite.unset]
    varied = {key: _list_values(key, values, source) for key, values in suite.vary.items()}
    labels = _short_names(list(varied))
    settings: list[SuiteSetting] = []
    for row in suite.row or [SuiteRow(name="")]:
        place = f"{source}: row {row.name!r}" if row.name else source
        row_overrides = list(_flatten_overrides(row.set, place))
        row_overrides += [Override(key, None, place) for key in row.unset]
        randomizations = _find_randomizations(suite, row.without, place)
        for combination in itertools.product(*varied.values()):
            name_parts = [row.name] if row.name else []
            varied_overrides: list[Override] = []
            for key, value in zip(varied, combination, strict=True):
                name_parts.append(f"{labels[key]} {_short_text(value)}")
                varied_overrides.append(Override(key, value, f"{source}: [vary]"))
            name = ", ".join(name_parts) or "as it is"
            number = None  # the place of the row on the horizontal axis, if a single number is varied
            if len(combination) == 1 and not row.name and _is_number(combination[0]):
                number = combination[0]
            overrides = [*common, *row_overrides, *varied_overrides]
            settings.append(SuiteSetting(name, overrides, number, randomizations))
    _check_names_differ(settings, source)
    return settings


def _check_names_differ(settings: Sequence[SuiteSetting], source: str) -> None:
    counts = Counter(setting.name for setting in settings)
    repeated = [name for name, count in counts.items() if count > 1]
    if repeated:
        raise ConfigError(f"{source}: two rows are called {min(repeated)!r}; rename one", code="config/duplicate-name")


def make_cases(suite: Suite, source: str, controllers: Sequence[str], fields: int, seed: int) -> list[Case]:
    """Return every case of a suite in the order of the table, with its whole configuration.

    The values that the suite sets are checked here on the first field of each row. A later field that cannot be laid
    out is named in its result.

    Args:
        suite: the suite.
        source: the suite's file, for messages.
        controllers: controllers to try; none: that of the scenario.
        fields: number of fields for each row and controller.
        seed: number of the first field.

    Raises:
        ConfigError: the suite is invalid, or has too many cases.
    """
    settings = make_settings(suite, source)
    count = len(settings) * len(controllers or [""]) * fields
    if count > MAX_CASES:
        raise ConfigError(f"{source}: {count} cases; at most {MAX_CASES} are allowed", code="command/invalid-option")
    cases: list[Case] = []
    for number, setting in enumerate(settings, 1):
        for controller in controllers or [None]:
            table = _compose_setting(suite, setting, controller)
            for field in range(seed, seed + fields):
                config = _configure_field(table, field, setting.randomizations)
                if field == seed:
                    _check_config(config, table, f"{source}, row {number} ({setting.name}), field {field}")
                cases.append(
                    Case(
                        id=case_id(config, suite.give_up_s),
                        row=number,
                        setting=setting.name,
                        controller=config.commander,
                        field=field,
                        config=encode_config(config),
                        give_up_s=suite.give_up_s,
                        limit_s=suite.limit_s,
                        value=setting.value,
                    )
                )
    return cases


def _compose_setting(suite: Suite, setting: SuiteSetting, controller: str | None) -> Table:
    """Return the scenario with the values of a setting. controller: None: that of the scenario."""
    overrides = [Override("clock_mode", "lockstep", "--clock-mode lockstep")]
    if controller:
        overrides.append(Override("controller", controller, f"--controllers {controller}"))
    return compose_table(suite.scenario, [*overrides, *setting.overrides])


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


def _check_config(config: RunConfig, table: Table, where: str) -> None:
    """Raise a ConfigError that names the place if a configuration cannot be run."""
    try:
        check(config)
        check_plugins(config, table)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}", code=error.code) from None


def seed_keys(table: Table) -> list[str]:
    """Return the keys that are set to a field's number: the run's seed, and that of every random field."""
    scene = table.values.get("scene")
    random_fields = scene.get("random_field") if isinstance(scene, dict) else None
    count = len(random_fields) if isinstance(random_fields, list) else 0
    return ["seed", *(f"scene.random_field.{i}.seed" for i in range(count))]


def _configure_field(table: Table, field: int, randomizations: Sequence[Randomization]) -> RunConfig:
    """Return the configuration of one field, with the values that are drawn for it."""
    for key in seed_keys(table):
        table.set_value(key, field, "--seed")
    for randomization in randomizations:
        for override in randomization.overrides_for_scene(field):
            table.set_value(override.key, override.value, override.flag)
    return decode(table, RunConfig)


def _find_randomizations(suite: Suite, without: Sequence[str], where: str) -> list[Randomization]:
    """Return the suite's randomizations without the keys that a row leaves out.

    Args:
        suite: the suite, with its randomizations.
        without: keys that the row does not randomize.
        where: the row, for the message.

    Raises:
        ConfigError: The row leaves out a key that is not randomized.
    """
    randomized_keys = {key for randomization in suite.randomize for key in randomization.set}
    for key in without:
        if key not in randomized_keys:
            raise ConfigError(
                f"{where}: `without` names {key!r}, which no [[randomize]] sets", code="command/invalid-option"
            )
    randomizations: list[Randomization] = []
    for randomization in suite.randomize:
        remaining_keys = [key for key in randomization.set if key not in without]
        if remaining_keys:
            randomizations.append(msgspec.structs.replace(randomization, set=remaining_keys))
    return randomizations


def _flatten_overrides(values: dict[str, Any], origin: str, prefix: str = "") -> Iterator[Override]:
    """Yield an override for each value; nested tables become dotted keys, and a list replaces the whole list."""
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from _flatten_overrides(value, origin, f"{prefix}{key}.")
        else:
            yield Override(prefix + key, value, origin)


def _list_values(key: str, values: list[Any] | str, source: str) -> list[Any]:
    """Return the values of a `[vary]` entry: those of the list, or evenly spaced ones. Raises ConfigError."""
    if isinstance(values, str):
        return space_evenly(values, f"{source}: `vary.{key}`")
    if not values:
        raise ConfigError(f"{source}: `vary.{key}` is empty; give at least one value", code="command/invalid-option")
    return values


def space_evenly(values: str, where: str) -> list[float]:
    """Return the numbers of `low:high:count`, both ends included. Raises ConfigError. where: for the message."""
    try:
        low, high, count = (float(part) for part in values.split(":"))
        is_finite = math.isfinite(low) and math.isfinite(high)
        is_a_count = count.is_integer() and 2 <= count <= 1000
        if not (is_finite and is_a_count):
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"{where} = {shorten(values)!r}: give low:high:count with a count of 2 to 1000, such as "
            "0.05:0.2:4, or a list",
            code="command/invalid-option",
        ) from None
    return [round(low + (high - low) * i / (count - 1), 12) for i in range(int(count))]


def _short_names(keys: list[str]) -> dict[str, str]:
    """Return the last part of each dotted key, or the whole key if two keys share the last part."""
    last_parts = [key.rpartition(".")[2] for key in keys]
    names: dict[str, str] = {}
    for key, last_part in zip(keys, last_parts, strict=True):
        is_unique = last_parts.count(last_part) == 1
        names[key] = last_part if is_unique else key
    return names


def _short_text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return shorten(str(value), 40)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
