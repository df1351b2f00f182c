"""`snakesim scenarios` and `snakesim config`: what is shipped, and what a scenario comes to."""

from typing import Any

import msgspec

from snakesim_hal.base.errors import short
from snakesim_hal.base.terminal import say, say_json
from snakesim_hal.model.files import leaves, read_part, shipped
from snakesim_hal.model.plugins import BACKENDS, CONTROLLERS, find_installed, in_file, plugin_settings
from snakesim_hal.model.scenario import Loaded
from snakesim_hal.programs.preflight import check_plugins

ABOUT = {"scenarios": "title", "robots": "about", "scenes": "about", "suites": "title"}  # where each says what it is


def list_shipped(*, as_json: bool) -> int:
    """Print the name of every shipped file, and what it is."""
    listed = {
        kind: {name: read_part(name, kind).values.get(about, "") for name in shipped(kind)}
        for kind, about in ABOUT.items()
    }
    if as_json:
        say_json(listed)
        return 0
    for kind, names in listed.items():
        say(f"{kind}:")
        for name, about in names.items():
            say(f"  {name:<18}{about}")
    return 0


def show_config(loaded: Loaded, *, as_json: bool) -> int:
    """Print every value, and where it came from. Raises ConfigError."""
    check_plugins(loaded.config, loaded.table, run_files=False)
    every = _every_value(loaded)
    if as_json:
        say_json({key: {"value": value, "origin": origin} for key, value, origin in every})
        return 0
    rows = [(key, short(repr(value) if isinstance(value, str) else str(value)), origin) for key, value, origin in every]
    key_width = max(len(key) for key, _, _ in rows)
    value_width = min(max(len(value) for _, value, _ in rows), 48)
    for key, value, origin in rows:
        say(f"{key:<{key_width}}  {value:<{value_width}}  {origin}")
    for section, name in (
        (loaded.config.control_section, loaded.config.controller),
        (loaded.config.backend_section, loaded.config.backend),
        *((f"services.{name}", service.code) for name, service in loaded.config.own_services.items()),
    ):
        if in_file(name):
            say(f"{section}: not checked, because that would run {name}; `snakesim run` checks it")
    return 0


def _every_value(loaded: Loaded) -> list[tuple[str, Any, str]]:
    """Those of the scenario, with every setting of the chosen controller and backend, whoever set it."""
    config, table = loaded.config, loaded.table
    rows = {key: (value, origin) for key, value, origin in loaded.explain() if key not in ("controllers", "backends")}
    for group, name, section, given in (
        (CONTROLLERS, config.controller, config.control_section, config.control_settings),
        (BACKENDS, config.backend, config.backend_section, config.backend_settings),
    ):
        plugin = find_installed(group, name)
        if plugin is not None:
            settings = msgspec.to_builtins(plugin_settings(plugin, given, table.source, section, table.origin))
            rows |= {key: (value, table.origin_of(key)) for key, value in leaves(settings, section)}
    return [(key, value, origin) for key, (value, origin) in rows.items()]
