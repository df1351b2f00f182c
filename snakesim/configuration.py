"""A scenario with what a caller sets, checked: `snakesim.run` and the environments take the same, and answer alike."""

import os
from collections.abc import Mapping
from typing import Any

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import Override, RunConfig, load
from snakesim_hal.programs.preflight import check_plugins


def overrides_of(given: Mapping[str, Any] | None, **arguments: Any) -> list[Override]:
    """What a caller sets. given: by dotted key; arguments: of the call, by the key that they stand for."""
    if given is not None and not (isinstance(given, Mapping) and all(isinstance(key, str) for key in given)):
        raise ConfigError(f"set={given!r:.60}: give a mapping of dotted keys, such as {{'control.propulsion_n': 35}}")
    values = {key: value for key, value in arguments.items() if value is not None}
    found = [Override(key, _plain(value), f"{key.removesuffix('_s')}={value!r:.60}") for key, value in values.items()]
    return found + [
        Override(key, _plain(value), f"set={{{key!r}: {value!r:.60}}}") for key, value in (given or {}).items()
    ]


def _plain(value: Any) -> Any:
    """Of a NumPy number or array the Python one; of a path its text."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.tolist() if hasattr(value, "tolist") else value


def checked(scenario: str, overrides: list[Override], *, processes: bool) -> RunConfig:
    """The configuration of a run, for which everything is there. Raises ConfigError."""
    clock_mode = next((override for override in overrides if override.key == "clock_mode"), None)
    if clock_mode is None and not processes:  # the only one there is in one process
        overrides = [*overrides, Override("clock_mode", "lockstep", "one process")]
    loaded = load(scenario, overrides)
    if clock_mode is not None and not processes and loaded.config.clock_mode != "lockstep":
        raise ConfigError(
            f"{clock_mode.flag}: in one process the clock mode is lockstep; leave it out, or add processes=True"
        )
    config = check_plugins(loaded.config, loaded.table)
    if clock_mode is not None and config.clock_mode != clock_mode.value:
        raise ConfigError(
            f"{clock_mode.flag}: backend {config.backend!r} cannot keep this clock mode, only {config.clock_mode}"
        )
    return config
