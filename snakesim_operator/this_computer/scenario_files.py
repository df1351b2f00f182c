"""`snakesim scenario list` lists the shipped files; `snakesim config` shows every value that a scenario results in."""

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from snakesim_hal.base.errors import shorten
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.controller import Controller, decode_parameters
from snakesim_hal.model.files import (
    ConfigTable,
    iterate_leaves,
    list_shipped_names,
    read_table_with_base,
)
from snakesim_hal.model.plugins import (
    BACKENDS,
    CONTROLLERS,
    decode_plugin_settings,
    is_file_plugin,
    load_plugin_unless_file,
    require_base_class,
)
from snakesim_hal.model.scenario import LoadedScenario, RunConfig
from snakesim_hal.programs.preflight import validate_and_complete_config

DESCRIPTION_KEYS = {
    "scenarios": "title",
    "robots": "description",
    "scenes": "description",
    "suites": "title",
}
MAX_VALUE_CHARACTERS = 48  # longer values are not aligned

Row = tuple[str, Any, str]  # key, value, and the file or flag that it came from


def print_shipped_files(*, as_json: bool) -> int:
    """Print the name and the description of every shipped file. Returns the exit code."""
    shipped_files: dict[str, dict[str, str]] = {}
    for kind, description_key in DESCRIPTION_KEYS.items():
        shipped_files[kind] = {
            name: read_table_with_base(name, kind).values.get(description_key, "")
            for name in list_shipped_names(kind)
        }
    if as_json:
        print_json(shipped_files)
        return 0
    for kind, descriptions in shipped_files.items():
        print_line(f"{kind}:")
        for name, description in descriptions.items():
            print_line(f"  {name:<18}{description}")
    return 0


def print_config(scenario: LoadedScenario, *, as_json: bool) -> int:
    """Print every value of a scenario, and the file or flag that it came from. Raises ConfigError.

    Returns the exit code.
    """
    validate_and_complete_config(scenario.config, scenario.table, load_file_plugins=False)
    rows = collect_values(scenario)
    if as_json:
        print_json({key: {"value": value, "origin": origin} for key, value, origin in rows})
        return 0
    _print_rows(rows)
    _print_unchecked_sections(scenario.config)
    return 0


def _print_rows(rows: Sequence[Row]) -> None:
    """Print key, value and origin in three columns."""
    texts = [shorten(repr(value) if isinstance(value, str) else str(value)) for _, value, _ in rows]
    key_width = max(len(key) for key, _, _ in rows)
    value_width = min(max(len(text) for text in texts), MAX_VALUE_CHARACTERS)
    for (key, _, origin), text in zip(rows, texts, strict=True):
        print_line(f"{key:<{key_width}}  {text:<{value_width}}  {origin}")


def _print_unchecked_sections(config: RunConfig) -> None:
    """Print which sections are not checked, because their plugin is a file whose code would run."""
    plugins = [
        (config.control_section, config.controller),
        (config.backend_section, config.backend),
    ]
    plugins += [
        (f"services.{name}", service.plugin) for name, service in config.internal_services.items()
    ]
    for section, plugin in plugins:
        if is_file_plugin(plugin):
            print_line(
                f"{section}: not checked, because that would run {plugin}; `snakesim run` checks it"
            )


def collect_values(scenario: LoadedScenario) -> list[Row]:
    """Return all values of the scenario, with every setting of the chosen controller and backend."""
    config = scenario.config
    table = scenario.table
    values: dict[str, tuple[Any, str]] = {}
    for key, value, origin in scenario.list_effective_values():
        if key not in ("controllers", "backends"):
            values[key] = (value, origin)
    for section, checked in _check_plugin_sections(config, table):
        for key, value in iterate_leaves(msgspec.to_builtins(checked), section):
            values[key] = (value, table.find_origin(key))
    return [(key, value, origin) for key, (value, origin) in values.items()]


def _check_plugin_sections(config: RunConfig, table: ConfigTable) -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and the checked values of the controller's and the backend's section; files are left out."""
    plugin = load_plugin_unless_file(CONTROLLERS, config.controller)
    if plugin is not None:
        controller = require_base_class(
            plugin, Controller, f"controller {shorten(config.controller)!r}"
        )
        section = config.control_section
        yield (
            section,
            decode_parameters(
                controller, config.controller_parameters, table.source, section, table.origin_by_key
            ),
        )
    backend = load_plugin_unless_file(BACKENDS, config.backend)
    if backend is not None:
        section = config.backend_section
        yield (
            section,
            decode_plugin_settings(
                backend, config.backend_settings, table.source, section, table.origin_by_key
            ),
        )
