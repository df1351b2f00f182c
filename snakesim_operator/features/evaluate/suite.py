"""The suite file: the conditions in which controllers are tried, each with several seeds.

    scenario = "clutter"                            # the base of all conditions
    seeds = 20                                      # number of seeds, without --seeds
    controllers = ["obstacle_triplet"]              # without --controllers
    stall_timeout_s = 12                            # robot time without 3 cm of advance that ends a run
    wall_timeout_s = 1800                           # wall time of one run, after which it counts as an error

    [set]                                           # in every condition; any value, as with --set
    duration_s = 45

    [vary]                                          # every combination is a condition
    "scene.random_field.0.density_per_m2" = [8, 12]
    "scene.ground.friction" = "0.05:0.4:3"          # from, to, how many

    [[condition]]                                   # or conditions by name; with [vary], each in every combination
    name = "no pose sensor"
    set.robot.safety.action = "hold"
    unset = ["robot.sensors.pose"]                  # optional keys that this condition removes
    not_randomized = ["scene.ground.friction"]      # keys that this condition does not randomize

    [[randomize]]                                   # in every trial: a number between two bounds, one for each seed.
    set = ["scene.ground.friction"]                 # It is the same for all conditions, controllers and listed keys
    low = 0.1
    high = 0.4

A trial is one run: one condition, one controller and one seed. The seed is that of the run and of every random field in
its scene, so each seed gives another random scene.
"""

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
from snakesim_hal.model.scene_file.randomization import Randomization
from snakesim_hal.model.textfiles import parse_toml

SeedCount = Annotated[int, Meta(ge=1, le=100_000)]
TimeLimitS = Annotated[float, Meta(gt=0, le=100_000, extra_json_schema={"unit": "s"})]

# Keys of suite files that were renamed before the first release, with their names today.
NEW_KEY_BY_FORMER_KEY = {
    "fields": "seeds",
    "row": "condition",
    "give_up_s": "stall_timeout_s",
    "limit_s": "wall_timeout_s",
    "fresh": "new_seeds",
}


class ConditionEntry(FileStruct, frozen=True, kw_only=True):
    """A condition with a name: `[[condition]]`. If the suite varies values, it is combined with all of them."""

    name: Annotated[str, Meta(min_length=1, max_length=80)]
    """Name of the condition in the table of results."""

    set: dict[str, Any] = {}
    """Values that this condition sets, as with `--set`, over those of the suite."""

    unset: list[str] = []
    """Optional keys that this condition removes, such as `robot.sensors.pose`."""

    not_randomized: list[str] = []
    """Keys that no [[randomize]] of the suite sets in this condition."""


class EvaluationSuite(FileStruct, frozen=True, kw_only=True):
    """A whole suite file."""

    title: str = ""
    """Description in one line, which lists of suites show."""

    scenario: Annotated[str, Meta(min_length=1)]
    """Scenario that all conditions are based on: the name of a shipped one, or a path."""

    seeds: SeedCount = 20
    """Number of seeds for each condition and controller, unless `--seeds` gives another. Each seed gives one trial with
    its own random scene.
    """

    controllers: list[str] = []
    """Controllers to try, unless `--controllers` gives others. Empty: that of the scenario."""

    stall_timeout_s: TimeLimitS = 12.0
    """Robot time without 3 cm of advance after which a run is ended."""

    wall_timeout_s: TimeLimitS = 1800.0
    """Wall time of one run after which it is stopped, and counts as an error."""

    set: dict[str, Any] = {}
    """Values that every condition sets, as with `--set`."""

    unset: list[str] = []
    """Optional keys that every condition removes."""

    vary: dict[str, list[Any] | str] = {}
    """For each key its values, as a list or as "LOW:HIGH:COUNT". Every combination of the values is a condition."""

    condition: list[ConditionEntry] = []
    """Conditions with a name, each an entry `[[condition]]`, combined with every combination of `vary`. Empty: only
    these combinations.
    """

    randomize: list[Randomization] = []
    """Random values, each an entry `[[randomize]]`. A value is the same for all conditions and controllers of one seed.
    """

    new_seeds: bool = False
    """True: every evaluation chooses new seeds at random. False: the first seed is 1. `--seed` overrides it."""


def read_suite(name: str) -> tuple[EvaluationSuite, str]:
    """Return a shipped suite or a suite file, and its path. Raises ConfigError."""
    path = resolve_file_path(name, "suites")
    table = read_table(path)
    _reject_former_keys(table, str(path))
    return decode_table(table, EvaluationSuite), str(path)


def _reject_former_keys(table: ConfigTable, source: str) -> None:
    """Raise a ConfigError that names the key of today if a suite file has a renamed key."""
    for former_key, new_key in NEW_KEY_BY_FORMER_KEY.items():
        if former_key in table.values:
            raise ConfigError(
                f"{source}: `{former_key}` is now called `{new_key}`; rename it in the file",
                code="config/unknown-key",
            )


def set_suite_values(suite: EvaluationSuite, values: dict[str, Any]) -> EvaluationSuite:
    """Return the suite with these keys set in every condition, over what suite and condition set."""
    conditions = [
        msgspec.structs.replace(condition, set={**condition.set, **values})
        for condition in suite.condition
    ]
    return msgspec.structs.replace(suite, set={**suite.set, **values}, condition=conditions)


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
