"""Loads a scenario with values that a Python program sets. `snakesim.run` and the environments share it."""

import os
from collections.abc import Mapping
from typing import Any

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario
from snakesim_hal.programs.preflight import validate_and_complete_config


def make_overrides(values: Mapping[str, Any] | None, **keyword_overrides: Any) -> list[KeyOverride]:
    """Convert the arguments of a Python call to overrides of a scenario.

    Args:
        values: Value of the caller's `set=` argument: a mapping of dotted keys to values. None if there are none.
        **keyword_overrides: Other arguments of the call, by the key that they set. None leaves the value of the
            scenario.

    Returns:
        The overrides: first those of `keyword_overrides`, then those of `values`.

    Raises:
        ConfigError: `values` is not a mapping with text keys.
    """
    if values is None:
        values = {}
    if not (isinstance(values, Mapping) and all(isinstance(key, str) for key in values)):
        raise ConfigError(
            f"set={values!r:.60}: give a mapping of dotted keys, such as {{'control.propulsion_n': 35}}",
            code="python/invalid-argument",
        )
    overrides: list[KeyOverride] = []
    for key, value in keyword_overrides.items():
        if value is not None:
            # The argument of the call has the name of the key without the unit, as `duration` for `duration_s`.
            source_text = f"{key.removesuffix('_s')}={value!r:.60}"
            overrides.append(KeyOverride(key, _convert_to_plain_value(value), source_text))
    for key, value in values.items():
        source_text = f"set={{{key!r}: {value!r:.60}}}"
        overrides.append(KeyOverride(key, _convert_to_plain_value(value), source_text))
    return overrides


def _convert_to_plain_value(value: Any) -> Any:
    """Return a NumPy number or array as a Python one, and a path as text."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    return value


def load_and_validate_config(
    scenario: str, overrides: list[KeyOverride], *, processes: bool
) -> RunConfig:
    """Load a scenario with overrides, check that all its plugins are installed, and return the configuration.

    Args:
        scenario: Name of a shipped scenario, or path of a scenario file.
        overrides: Values that replace those of the scenario.
        processes: Whether HAL host and services run in processes of their own. If False, they run in this process, and
            the clock mode is lockstep.

    Raises:
        ConfigError: A value is wrong, a plugin is missing, or the clock mode is not possible.
    """
    clock_override = next(
        (override for override in overrides if override.key == "clock_mode"), None
    )
    if clock_override is None and not processes:
        overrides = [*overrides, KeyOverride("clock_mode", "lockstep", "one process")]
    loaded = load_scenario(scenario, overrides)
    if clock_override is not None and not processes and loaded.config.clock_mode != "lockstep":
        raise ConfigError(
            f"{clock_override.flag}: in one process the clock mode is lockstep; leave it out, or add processes=True",
            code="backend/wrong-clock-mode",
        )
    config = validate_and_complete_config(loaded.config, loaded.table)
    if clock_override is not None and config.clock_mode != clock_override.value:
        raise ConfigError(
            f"{clock_override.flag}: backend {config.backend!r} cannot keep this clock mode, only {config.clock_mode}",
            code="backend/wrong-clock-mode",
        )
    return config
