"""Reads a scenario with its robot and its scene, applies the flags of the command line, and checks everything at once.

Every process of a run gets the result, and it is enough to repeat the run.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import (
    ConfigTable,
    decode_table,
    iterate_leaves,
    read_table,
    read_table_with_base,
    resolve_file_path,
)
from snakesim_hal.model.scenario.run_config import (
    POLICY,
    POLICY_CONTROLLER,
    RunConfig,
    get_section_name,
)
from snakesim_hal.model.scenario.start_pose import validate_start_pose
from snakesim_hal.model.scene_file.fitting import compute_scaled_scene_values
from snakesim_hal.model.textfiles import parse_toml

# Prefixes of --set keys: `control.x` is a parameter of the chosen controller, `backend.x` one of the chosen backend.
CHOSEN_PREFIXES = ("control.", "backend.")


@dataclass(frozen=True)
class LoadedScenario:
    """A checked configuration, with the origin of each value."""

    config: RunConfig
    table: ConfigTable

    def list_effective_values(self) -> list[tuple[str, Any, str]]:
        """Return every effective value as (dotted key, value, file or flag or `default`)."""
        effective = msgspec.to_builtins(self.config)
        return [
            (key, value, self.table.find_origin(key)) for key, value in iterate_leaves(effective)
        ]


@dataclass(frozen=True)
class KeyOverride:
    """A value that the command line gives for one key."""

    key: str  # dotted
    value: Any
    flag: str  # as written on the command line, for error messages


def parse_set_option(text: str) -> KeyOverride:
    """Parse the text `section.key=value` of a --set option.

    The value is read as TOML. If it is not valid TOML, it is taken as plain text.

    Args:
        text: Text behind --set.

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
    return KeyOverride(key, parsed, f"--set {shorten(text)}")


def load_scenario(scenario: str, overrides: Sequence[KeyOverride] = ()) -> LoadedScenario:
    """Read a scenario with its robot and scene, apply the flags, and check the result.

    Args:
        scenario: Name of a shipped scenario, or path of a scenario file.
        overrides: Values from the command line.

    Raises:
        ConfigError: A file cannot be read, or a value is not allowed.
    """
    table = compose_config_table(scenario, overrides)
    config = decode_table(table, RunConfig)
    validate_start_pose(config)
    return LoadedScenario(config, table)


def compose_config_table(scenario: str, overrides: Sequence[KeyOverride] = ()) -> ConfigTable:
    """Compose the values of a scenario, its robot and its scene, and apply the flags. The values are not checked yet.

    Args:
        scenario: Name of a shipped scenario, or path of a scenario file.
        overrides: Values from the command line.

    Returns:
        All values, each with the file or flag that it comes from. The scene is scaled to the robot.

    Raises:
        ConfigError: A file cannot be read.
    """
    path = resolve_file_path(scenario, "scenarios")
    table = read_table(path)
    table.values.setdefault("name", path.stem)
    _split_policy_controller(table, table.values.get("controller"), table.source)

    # Another robot or scene is chosen before its single values are changed.
    file_choices = [override for override in overrides if override.key in ("robot", "scene")]
    for choice in file_choices:
        table.set_value(choice.key, choice.value, choice.flag)
    chosen_by_flag = {choice.key for choice in file_choices}
    for part, kind in (("robot", "robots"), ("scene", "scenes")):
        # A path on the command line is relative to the working directory, a path in the scenario to its folder.
        base_dir = None if part in chosen_by_flag else path.parent
        _replace_name_by_file(table, part, kind, base_dir)

    # A controller or backend is chosen before the keys that refer to the chosen one.
    value_overrides = [override for override in overrides if override not in file_choices]
    for override in sorted(
        value_overrides, key=lambda override: override.key.startswith(CHOSEN_PREFIXES)
    ):
        _apply_override(table, override)

    scene = table.values.get("scene")
    if isinstance(scene, dict) and "reference_robot" in scene:
        _scale_scene_to_robot(table, flags={override.flag for override in value_overrides})
    return table


def _replace_name_by_file(table: ConfigTable, part: str, kind: str, base_dir: Path | None) -> None:
    """Replace the name of a robot or scene in the table by the content of its file, unless it is there already."""
    name = table.values.get(part)
    if not isinstance(name, str):
        return
    included = read_table_with_base(name, kind, base_dir)
    table.set_value(part, included.values, included.source)
    # With `extends`, the values of one part come from two files.
    table.origin_by_key |= {
        f"{part}.{key}": origin for key, origin in included.origin_by_key.items()
    }


def _apply_override(table: ConfigTable, override: KeyOverride) -> None:
    """Put a value from the command line into the table."""
    key = _expand_chosen_key(table, override.key)
    table.set_value(key, override.value, override.flag)
    if key == "controller":
        _split_policy_controller(table, override.value, override.flag)


def _expand_chosen_key(table: ConfigTable, key: str) -> str:
    """Return the key in the section of the chosen controller or backend, for `control.KEY` or `backend.KEY`."""
    control_prefix, backend_prefix = CHOSEN_PREFIXES
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
    return f"{section}.{get_section_name(str(chosen))}.{key.removeprefix(prefix)}"


def _scale_scene_to_robot(table: ConfigTable, flags: set[str]) -> None:
    """Scale a scene that was laid out for another robot, except for values that a flag sets. See fitting.py."""
    config = decode_table(table, RunConfig)

    def is_set_by_flag(key: str) -> bool:
        return table.find_origin(f"scene.{key}") in flags

    changed = compute_scaled_scene_values(config.scene, config.robot, is_set_by_flag)
    for key, value in changed.items():
        table.set_value(f"scene.{key}", value, f"fitted to robot {config.robot.name!r}")


def _split_policy_controller(table: ConfigTable, controller: Any, origin: str) -> None:
    """Replace the controller `policy:MODEL` by the controller `policy` and its parameter `model`."""
    if isinstance(controller, str) and controller.startswith(POLICY):
        table.set_value("controller", POLICY_CONTROLLER, origin)
        table.set_value(
            f"controllers.{POLICY_CONTROLLER}.model", controller.removeprefix(POLICY), origin
        )
