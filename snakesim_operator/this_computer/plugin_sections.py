"""The sections of a scenario that plugins read: which Struct checks each, and which plugins this project ships."""

from collections.abc import Iterator
from typing import Any

import msgspec

from snakesim_hal.controller import Controller, decode_parameters
from snakesim_hal.model.plugins import find_plugin, list_installed, plugin_settings


def list_shipped_plugins(group: str) -> Iterator[tuple[str, Any]]:
    """Yield name and object of every installed plugin of a group that belongs to this project."""
    for name in list_installed(group):
        plugin = find_plugin(group, name)
        if plugin.__module__.startswith("snakesim_"):
            yield name, plugin


def section_type(plugin: Any) -> type[msgspec.Struct]:
    """Return the Struct of a plugin's section: the parameters of a controller, or the settings of another plugin."""
    return plugin.Parameters if _is_controller(plugin) else plugin.Settings


def decode_section(
    plugin: Any, values: dict[str, Any], source: str, section: str, origin: dict[str, str] | None = None
) -> msgspec.Struct:
    """Return the decoded section of a plugin.

    Args:
        plugin: a controller, a backend or a physics model.
        values: the section as read.
        source: file that contains it, for errors.
        section: dotted key of the section, for errors.
        origin: file or option of each dotted key, as far as known.

    Raises:
        ConfigError: A value is not allowed.
    """
    decode = decode_parameters if _is_controller(plugin) else plugin_settings
    return decode(plugin, values, source, section, origin)


def _is_controller(plugin: Any) -> bool:
    return isinstance(plugin, type) and issubclass(plugin, Controller)
