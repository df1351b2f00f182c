"""The sections of a scenario that plugins read: which Struct checks each, and which plugins this project ships."""

from collections.abc import Iterator
from typing import Any

import msgspec

from snakesim_hal.controller import Controller, decode_parameters
from snakesim_hal.model.plugins import decode_plugin_settings, list_installed_plugins, load_plugin


def find_bundled_plugins(group: str) -> Iterator[tuple[str, Any]]:
    """Yield name and object of every installed plugin of a group that belongs to this project."""
    for name in list_installed_plugins(group):
        plugin = load_plugin(group, name)
        if plugin.__module__.startswith("snakesim_"):
            yield name, plugin


def get_section_type(plugin: Any) -> type[msgspec.Struct]:
    """Return the Struct of a plugin's section: the parameters of a controller, or the settings of another plugin."""
    return plugin.Parameters if _is_controller(plugin) else plugin.Settings


def decode_section(
    plugin: Any,
    values: dict[str, Any],
    source: str,
    section_key: str,
    origin_by_key: dict[str, str] | None = None,
) -> msgspec.Struct:
    """Decode and check the section of a scenario that a plugin reads.

    Args:
        plugin: Class of a controller, a backend or a physics model.
        values: The section as read from the file.
        source: Name of the file that contains the section, for errors.
        section_key: Dotted key of the section, for errors.
        origin_by_key: File or option that each value comes from, by dotted key, as far as known.

    Raises:
        ConfigError: A value is not allowed.
    """
    decode = decode_parameters if _is_controller(plugin) else decode_plugin_settings
    return decode(plugin, values, source, section_key, origin_by_key)


def _is_controller(plugin: Any) -> bool:
    return isinstance(plugin, type) and issubclass(plugin, Controller)
