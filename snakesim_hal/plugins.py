"""Backends, controllers, services and the like are found by name: an entry point of an installed package, or a file.

`wave` is looked up among the entry points; `./wave.py:Wave` is the object `Wave` of that file, for trying things out.
"""

import importlib.util
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.errors import ConfigError
from snakesim_hal.files import Table, decode

BACKENDS = "snakesim.backends"
COMMANDS = "snakesim.commands"
CONTROLLERS = "snakesim.controllers"
PLANTS = "snakesim.plants"
SERVICES = "snakesim.services"


def installed(group: str) -> list[str]:
    """Names of everything that is installed in a group."""
    return sorted({entry.name for entry in entry_points(group=group)})


def find_plugin(group: str, name: str) -> Any:
    """Load what a name stands for. Raises ConfigError that says what is installed."""
    kind = group.rpartition(".")[2].removesuffix("s")
    if ".py:" in name:
        return _from_file(name, kind)
    found: dict[str, EntryPoint] = {entry.name: entry for entry in entry_points(group=group)}
    if name not in found:
        raise ConfigError(
            f"no {kind} called {name!r} is installed; installed are {', '.join(sorted(found)) or 'none'}. "
            f"A package adds one by an entry point in the group {group!r}"
        )
    try:
        return found[name].load()
    except ModuleNotFoundError as error:
        raise ConfigError(f"{kind} {name!r} cannot be loaded: {error}.{_extras_of(found[name])}") from error
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{kind} {name!r} ({found[name].value}) cannot be loaded: {error}") from error


def _extras_of(entry: EntryPoint) -> str:
    """How to install what a plugin needs and its package does not install by itself."""
    extras = entry.dist.metadata.get_all("Provides-Extra") if entry.dist is not None else None
    if entry.dist is None or not extras:
        return ""
    return f" Install it with: pip install '{entry.dist.name}[{','.join(extras)}]'"


def _from_file(name: str, kind: str) -> Any:
    path_text, _, attribute = name.rpartition(":")
    path = Path(path_text).expanduser().resolve()
    if not path.is_file():
        raise ConfigError(f"{kind} {name!r}: there is no file {path}")
    spec = importlib.util.spec_from_file_location(f"snakesim_plugin_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{kind} {name!r}: {path} cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
        return getattr(module, attribute)
    except (ImportError, SyntaxError, NameError, AttributeError) as error:
        raise ConfigError(f"{kind} {name!r} cannot be loaded: {type(error).__name__}: {error}") from error


def plugin_settings(
    plugin: Any, section: dict[str, Any], source: str, where: str, origin: dict[str, str] | None = None
) -> Any:
    """A plugin's section of the configuration, checked by its own `Settings`.

    source, origin: the file, and what is known of where each of its dotted keys came from.
    """
    settings = getattr(plugin, "Settings", None)
    if not (isinstance(settings, type) and issubclass(settings, msgspec.Struct)):
        raise ConfigError(
            f"{plugin!r} has no `Settings` Struct; a plugin states its settings there, if only an empty one"
        )
    return decode(Table(section, source, origin or {}), settings, where)
