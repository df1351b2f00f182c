"""Loads a scenario with values that a Python program sets. `snakesim.run` and the environments share it."""

import os
from collections.abc import Mapping
from typing import Any

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import Override, RunConfig, load
from snakesim_hal.programs.preflight import check_plugins


def list_overrides(values: Mapping[str, Any] | None, **arguments: Any) -> list[Override]:
    """Return the values that a caller sets, as overrides of the scenario.

    Args:
        values: The argument `set` of the caller: values by their dotted keys.
        **arguments: Other arguments of the caller, by the key that they stand for. None is left out.

    Raises:
        ConfigError: `values` is no mapping of keys.
    """
    if values is None:
        values = {}
    if not (isinstance(values, Mapping) and all(isinstance(key, str) for key in values)):
        raise ConfigError(
            f"set={values!r:.60}: give a mapping of dotted keys, such as {{'control.propulsion_n': 35}}",
            code="python/invalid-argument",
        )
    overrides: list[Override] = []
    for key, value in arguments.items():
        if value is not None:
            flag = f"{key.removesuffix('_s')}={value!r:.60}"
            overrides.append(Override(key, _to_plain(value), flag))
    for key, value in values.items():
        flag = f"set={{{key!r}: {value!r:.60}}}"
        overrides.append(Override(key, _to_plain(value), flag))
    return overrides


def _to_plain(value: Any) -> Any:
    """Return a NumPy number or array as a Python one, and a path as text."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    return value


def load_checked(scenario: str, overrides: list[Override], *, processes: bool) -> RunConfig:
    """Return the configuration of a run, for which all plugins are there.

    Args:
        scenario: Name of a shipped scenario, or path of a file.
        overrides: Values that replace those of the scenario.
        processes: Whether the run has processes of its own. In one process the clock mode is lockstep.

    Raises:
        ConfigError: A value is wrong, a plugin is missing, or the clock mode is not possible.
    """
    clock_mode = next((override for override in overrides if override.key == "clock_mode"), None)
    if clock_mode is None and not processes:
        overrides = [*overrides, Override("clock_mode", "lockstep", "one process")]
    loaded = load(scenario, overrides)
    if clock_mode is not None and not processes and loaded.config.clock_mode != "lockstep":
        raise ConfigError(
            f"{clock_mode.flag}: in one process the clock mode is lockstep; leave it out, or add processes=True",
            code="backend/wrong-clock-mode",
        )
    config = check_plugins(loaded.config, loaded.table)
    if clock_mode is not None and config.clock_mode != clock_mode.value:
        raise ConfigError(
            f"{clock_mode.flag}: backend {config.backend!r} cannot keep this clock mode, only {config.clock_mode}",
            code="backend/wrong-clock-mode",
        )
    return config
