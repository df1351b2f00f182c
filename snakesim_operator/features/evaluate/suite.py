"""The suite file: settings that a controller is tried in, each on many fields.

    scenario = "field"                              # what all cases begin with
    fields = 20                                     # when --fields is not given
    controllers = ["obstacle_triplet"]              # when --controllers is not given
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
    without = ["scene.ground.friction"]             # no draw of these

    [[draw]]                                        # in every case, evenly between two numbers, one draw a field:
    set = ["scene.ground.friction"]                 # the same for every row and controller, and for all keys listed
    low = 0.1
    high = 0.4

A field is a number: the run's seed, and that of every random field in the scene.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, short
from snakesim_hal.model.drawn import Draw
from snakesim_hal.model.files import FileStruct, Table, decode, find, read_table
from snakesim_hal.model.scenario import Override, RunConfig, check, compose, written
from snakesim_hal.model.textfiles import parse_toml
from snakesim_hal.programs.preflight import check_plugins
from snakesim_operator.features.evaluate.case import Case, case_id

MAX_CASES = 200_000
Count = Annotated[int, Meta(ge=1, le=100_000)]


class Row(FileStruct, frozen=True, kw_only=True):
    """A setting by name."""

    name: Annotated[str, Meta(min_length=1, max_length=80)]
    set: dict[str, Any] = {}
    unset: list[str] = []
    without: list[str] = []


class Suite(FileStruct, frozen=True, kw_only=True):
    """A whole suite file."""

    title: str = ""
    scenario: Annotated[str, Meta(min_length=1)]
    fields: Count = 20
    controllers: list[str] = []
    give_up_s: Annotated[float, Meta(gt=0, le=100_000, extra_json_schema={"unit": "s"})] = 12.0
    limit_s: Annotated[float, Meta(gt=0, le=100_000, extra_json_schema={"unit": "s"})] = 1800.0
    set: dict[str, Any] = {}
    unset: list[str] = []
    vary: dict[str, list[Any] | str] = {}
    row: list[Row] = []
    draw: list[Draw] = []
    fresh: bool = False  # fields that nobody has seen are drawn, unless --seed says which


@dataclass(frozen=True)
class Setting:
    """One row of the table: what is set, and its name."""

    name: str
    overrides: list[Override]
    value: float | None = None  # of what is varied, if that is one number
    draws: Sequence[Draw] = ()


def read_suite(name: str) -> tuple[Suite, str]:
    """A shipped suite or a file, and where it came from. Raises ConfigError."""
    path = find(name, "suites")
    return decode(read_table(path), Suite), str(path)


def also_set(suite: Suite, given: dict[str, Any]) -> Suite:
    """The suite with these keys set in every row, over what suite and row say."""
    rows = [msgspec.structs.replace(row, set={**row.set, **given}) for row in suite.row]
    return msgspec.structs.replace(suite, set={**suite.set, **given}, row=rows)


def rows_of(cases: Sequence[Case], rows: Sequence[int], source: str) -> list[Case]:
    """Those of some rows, by number; none: of all. Raises ConfigError."""
    if wrong := next((row for row in rows if row not in {case.row for case in cases}), None):
        raise ConfigError(f"--rows {wrong}: {source} has rows 1 to {cases[-1].row}")
    return [case for case in cases if not rows or case.row in rows]


def settings_of(suite: Suite, source: str) -> list[Setting]:
    """The rows of the table in order. Raises ConfigError."""
    always = [*_overrides(suite.set, f"{source}: [set]")]
    always += [Override(key, None, f"{source}: `unset`") for key in suite.unset]
    varied = {key: _values(key, given, source) for key, given in suite.vary.items()}
    words = _short_names(list(varied))
    found: list[Setting] = []
    for row in suite.row or [Row(name="")]:
        where = f"{source}: row {row.name!r}" if row.name else source
        own = [*_overrides(row.set, where), *(Override(key, None, where) for key in row.unset)]
        draws = _draws(suite, row.without, where)
        for values in itertools.product(*varied.values()):
            parts = [f"{words[key]} {_short_text(value)}" for key, value in zip(varied, values, strict=True)]
            name = ", ".join(filter(None, [row.name, *parts])) or "as it is"
            here = [Override(key, v, f"{source}: [vary]") for key, v in zip(varied, values, strict=True)]
            number = values[0] if len(values) == 1 and not row.name and _is_number(values[0]) else None
            found.append(Setting(name, [*always, *own, *here], number, draws))
    twice = {one.name for one in found if sum(other.name == one.name for other in found) > 1}
    if twice:
        raise ConfigError(f"{source}: two rows are called {min(twice)!r}; rename one")
    return found


def cases_of(suite: Suite, source: str, controllers: Sequence[str], fields: int, seed: int) -> list[Case]:
    """Every case in the order of the table, with its whole configuration. Raises ConfigError.

    What the suite asks for is checked here on the first field of each row; a later field that cannot be laid out is
    named in its result.
    """
    settings = settings_of(suite, source)
    if (count := len(settings) * len(controllers or [""]) * fields) > MAX_CASES:
        raise ConfigError(f"{source}: {count} cases; at most {MAX_CASES} are allowed")
    found: list[Case] = []
    for number, setting in enumerate(settings, 1):
        for controller in controllers or [None]:
            chosen = [Override("controller", controller, f"--controllers {controller}")] if controller else []
            clock_mode = Override("clock_mode", "lockstep", "--clock-mode lockstep")
            table = compose(suite.scenario, [clock_mode, *chosen, *setting.overrides])
            for field in range(seed, seed + fields):
                config = _on_field(table, field, setting.draws)
                if field == seed:
                    _check(config, table, f"{source}, row {number} ({setting.name}), field {field}")
                found.append(
                    Case(
                        case_id(config, suite.give_up_s),
                        number,
                        setting.name,
                        config.commander,
                        field,
                        written(config),
                        suite.give_up_s,
                        suite.limit_s,
                        setting.value,
                    )
                )
    return found


def parse_vary(text: str) -> tuple[str, list[Any] | str]:
    """`key=low:high:count` or `key=[a, b, c]` of --vary. Raises ConfigError."""
    key, equals, given = (part.strip() for part in text.partition("="))
    if not (key and equals and given):
        raise ConfigError(f"--vary {short(text)}: give key=low:high:count, such as control.look_ahead_m=0.05:0.2:4")
    if not given.startswith("["):
        return key, given
    try:
        return key, parse_toml(f"value = {given}", "--vary")["value"]
    except ConfigError:
        raise ConfigError(f"--vary {short(text)}: {short(given)} is no list; write it as in TOML, [1, 2]") from None


def _check(config: RunConfig, table: Table, where: str) -> None:
    try:
        check(config)
        check_plugins(config, table)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def seeds_of(table: Table) -> list[str]:
    """The settings that a field's number stands for."""
    scene = table.values.get("scene")
    random_fields = scene.get("random_field") if isinstance(scene, dict) else None
    count = len(random_fields) if isinstance(random_fields, list) else 0
    return ["seed", *(f"scene.random_field.{i}.seed" for i in range(count))]


def _on_field(table: Table, field: int, draws: Sequence[Draw] = ()) -> RunConfig:
    for key in seeds_of(table):
        table.put(key, field, "--seed")
    for draw in draws:
        for override in draw.on_field(field):
            table.put(override.key, override.value, override.flag)
    return decode(table, RunConfig)


def _draws(suite: Suite, without: Sequence[str], where: str) -> list[Draw]:
    """Those of the suite that a row keeps. Raises ConfigError."""
    drawn = {key for draw in suite.draw for key in draw.set}
    if wrong := next((key for key in without if key not in drawn), None):
        raise ConfigError(f"{where}: `without` names {wrong!r}, which no [[draw]] sets")
    kept = [[key for key in draw.set if key not in without] for draw in suite.draw]
    return [msgspec.structs.replace(draw, set=keys) for draw, keys in zip(suite.draw, kept, strict=True) if keys]


def _overrides(given: dict[str, Any], origin: str, prefix: str = "") -> Iterator[Override]:
    """Nested tables are dotted keys; a list replaces the whole list."""
    for key, value in given.items():
        if isinstance(value, dict) and value:
            yield from _overrides(value, origin, f"{prefix}{key}.")
        else:
            yield Override(prefix + key, value, origin)


def _values(key: str, given: list[Any] | str, source: str) -> list[Any]:
    if isinstance(given, list):
        if not given:
            raise ConfigError(f"{source}: `vary.{key}` is empty; give at least one value")
        return given
    return spaced(given, f"{source}: `vary.{key}`")


def spaced(given: str, where: str) -> list[float]:
    """The numbers of `low:high:count`, both ends included."""
    try:
        low, high, count = (float(part) for part in given.split(":"))
        if not (math.isfinite(low) and math.isfinite(high) and count.is_integer() and 2 <= count <= 1000):
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"{where} = {short(given)!r}: give low:high:count with a count of 2 to 1000, such as 0.05:0.2:4, or a list"
        ) from None
    return [round(low + (high - low) * i / (count - 1), 12) for i in range(int(count))]


def _short_names(keys: list[str]) -> dict[str, str]:
    """The last part of each dotted key, or all of it where two keys share that."""
    last = [key.rpartition(".")[2] for key in keys]
    return {key: end if last.count(end) == 1 else key for key, end in zip(keys, last, strict=True)}


def _short_text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else short(str(value), 40)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
