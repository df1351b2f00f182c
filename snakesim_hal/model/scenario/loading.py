"""Reads a scenario with its robot and its scene, applies the flags of the command line, and checks everything at once.

Every process of a run gets the result, and it is enough to repeat the run.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import Table, decode, find_file, leaves, read_part, read_table
from snakesim_hal.model.fitting import fit_scene
from snakesim_hal.model.scenario.run_config import POLICY, POLICY_CONTROLLER, RunConfig, section_name
from snakesim_hal.model.scenario.start_pose import check
from snakesim_hal.model.textfiles import parse_toml

# Prefixes of --set keys: `control.x` is a parameter of the chosen controller, `backend.x` one of the chosen backend.
CHOSEN = ("control.", "backend.")


@dataclass(frozen=True)
class Loaded:
    """A checked configuration, with the origin of each value."""

    config: RunConfig
    table: Table

    def explain(self) -> list[tuple[str, Any, str]]:
        """Return every effective value as (dotted key, value, file or flag or `default`)."""
        effective = msgspec.to_builtins(self.config)
        return [(key, value, self.table.origin_of(key)) for key, value in leaves(effective)]


@dataclass(frozen=True)
class Override:
    """A value that the command line gives for one key."""

    key: str  # dotted
    value: Any
    flag: str  # as written on the command line, for error messages


def parse_set(text: str) -> Override:
    """Parse the `section.key=value` of a --set option.

    The value is read as TOML. If it is not valid TOML, it is taken as plain text.

    Raises:
        ConfigError: The key or the equals sign is missing.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ConfigError(
            f"--set {shorten(text)}: give section.key=value, such as --set control.propulsion_n=35",
            code="command/invalid-option",
        )
    try:
        parsed = parse_toml(f"value = {value}", "--set")["value"]
    except ConfigError:
        parsed = value.strip()
    return Override(key, parsed, f"--set {shorten(text)}")


def load(scenario: str, overrides: Sequence[Override] = ()) -> Loaded:
    """Read a scenario with its robot and scene, apply the flags, and check the result.

    Args:
        scenario: the name of a shipped scenario, or the path of a file.
        overrides: values from the command line.

    Raises:
        ConfigError: A file cannot be read, or a value is not allowed.
    """
    table = compose_table(scenario, overrides)
    config = decode(table, RunConfig)
    check(config)
    return Loaded(config, table)


def compose_table(scenario: str, overrides: Sequence[Override] = ()) -> Table:
    """Return all values of a scenario, its robot and its scene, with the flags applied, but not checked yet.

    Raises:
        ConfigError: A file cannot be read.
    """
    path = find_file(scenario, "scenarios")
    table = read_table(path)
    table.values.setdefault("name", path.stem)
    _split_policy(table, table.values.get("controller"), table.source)

    # Another robot or scene is chosen before its single values are changed.
    file_choices = [override for override in overrides if override.key in ("robot", "scene")]
    for choice in file_choices:
        table.set_value(choice.key, choice.value, choice.flag)
    chosen_by_flag = {choice.key for choice in file_choices}
    for part, kind in (("robot", "robots"), ("scene", "scenes")):
        relative_to = None if part in chosen_by_flag else path.parent
        _include_file(table, part, kind, relative_to)

    # A controller or backend is chosen before the keys that refer to the chosen one.
    value_overrides = [override for override in overrides if override not in file_choices]
    for override in sorted(value_overrides, key=lambda override: override.key.startswith(CHOSEN)):
        _apply_override(table, override)

    scene = table.values.get("scene")
    if isinstance(scene, dict) and "reference_robot" in scene:
        _fit_scene(table, flags={override.flag for override in value_overrides})
    return table


def _include_file(table: Table, part: str, kind: str, relative_to: Path | None) -> None:
    """Replace the name of a robot or scene by the contents of its file; do nothing if the contents are there."""
    name = table.values.get(part)
    if not isinstance(name, str):
        return
    included = read_part(name, kind, relative_to)
    table.set_value(part, included.values, included.source)
    # With `extends`, the values of one part come from two files.
    table.origin |= {f"{part}.{key}": origin for key, origin in included.origin.items()}


def _apply_override(table: Table, override: Override) -> None:
    """Put a value from the command line into the table."""
    key = _expand_chosen(table, override.key)
    table.set_value(key, override.value, override.flag)
    if key == "controller":
        _split_policy(table, override.value, override.flag)


def _expand_chosen(table: Table, key: str) -> str:
    """Return the key in the section of the chosen controller or backend, for `control.KEY` or `backend.KEY`."""
    control_prefix, backend_prefix = CHOSEN
    if key.startswith(control_prefix):
        prefix = control_prefix
        chosen = table.values.get("controller", "sim")
        section = "controllers"
    elif key.startswith(backend_prefix):
        prefix = backend_prefix
        chosen = table.values.get("backend", "sim")
        section = "backends"
    else:
        return key
    return f"{section}.{section_name(str(chosen))}.{key.removeprefix(prefix)}"


def _fit_scene(table: Table, flags: set[str]) -> None:
    """Change a scene that was laid out for another robot, except for the values that a flag gives; see fitting.py."""
    config = decode(table, RunConfig)

    def is_set_by_flag(key: str) -> bool:
        return table.origin_of(f"scene.{key}") in flags

    changed = fit_scene(config.scene, config.robot, is_set_by_flag)
    for key, value in changed.items():
        table.set_value(f"scene.{key}", value, f"fitted to robot {config.robot.name!r}")


def _split_policy(table: Table, controller: Any, origin: str) -> None:
    """Replace the controller `policy:MODEL` by the controller `policy` and its parameter `model`."""
    if isinstance(controller, str) and controller.startswith(POLICY):
        table.set_value("controller", POLICY_CONTROLLER, origin)
        table.set_value(f"controllers.{POLICY_CONTROLLER}.model", controller.removeprefix(POLICY), origin)
