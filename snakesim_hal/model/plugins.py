"""Find backends, controllers and services by name: an entry point of an installed package, or a class in a file.

`wave` is looked up among the entry points. `./wave.py:Wave` is the object `Wave` of that file, for development. A
program that runs everything in one process may also offer its own objects by name.
"""

import ast
import contextlib
import importlib.util
import inspect
import sys
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.model.files import ConfigTable, decode_table, expand_home
from snakesim_hal.model.sibling_modules import enable_sibling_imports
from snakesim_hal.model.textfiles import read_bytes

BaseT = TypeVar("BaseT")

# Groups of entry points.
BACKENDS = "snakesim.backends"
COMMANDS = "snakesim.commands"
CONTROLLERS = "snakesim.controllers"
FILES = "snakesim.files"  # Structs of the kinds of files that only a feature reads, such as suites
FILMS = "snakesim.films"
PHYSICS_MODELS = "snakesim.physics_models"
SENSORS = "snakesim.sensors"
SERVICES = "snakesim.services"
_registered_plugins: dict[tuple[str, str], Any] = {}


@contextlib.contextmanager
def register_plugin_temporarily(group: str, name: str, plugin: Any) -> Iterator[None]:
    """Register an object as a plugin in this process, for as long as the context lasts.

    It has precedence over an installed plugin of the same name.

    Args:
        group: Group of entry points, such as CONTROLLERS.
        name: Name of the plugin.
        plugin: Object that `load_plugin` returns for the name.
    """
    previous_plugins = _registered_plugins.copy()
    _registered_plugins[group, name] = plugin
    try:
        yield
    finally:
        _registered_plugins.clear()
        _registered_plugins.update(previous_plugins)


def has_registered_plugins() -> bool:
    """Return whether plugins are registered in this process, which no other process could find."""
    return bool(_registered_plugins)


def list_installed_plugins(group: str) -> list[str]:
    """Return the names of all installed plugins of a group."""
    return sorted({entry.name for entry in _read_entry_points(*sys.path).select(group=group)})


@cache
def _read_entry_points(*_path: str) -> EntryPoints:
    """Return every entry point on a path. Reading them takes 7 ms, and a run looks up a dozen, so they are cached."""
    # Before Python 3.12 of another class, which has the same `select`.
    all_entries: Any = entry_points()
    return all_entries


def load_plugin(group: str, name: str) -> Any:
    """Load a plugin: a registered object, a class in a file, or an installed entry point. The code of a file is run.

    Args:
        group: Group of entry points, such as CONTROLLERS.
        name: Name of an entry point, or `./file.py:Class`.

    Raises:
        ConfigError: There is no such plugin, or it cannot be loaded. The error lists the installed plugins.
    """
    kind_name = _get_kind_name(group)
    if (group, name) in _registered_plugins:
        return _registered_plugins[group, name]
    if is_file_plugin(name):
        return _load_from_file(name, kind_name)
    entry = _find_entry_point(group, name, kind_name)
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{kind_name} {name!r} cannot be loaded: {error}.{_make_install_hint(entry)}",
            code="extra/not-installed",
        ) from error
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{kind_name} {name!r} ({entry.value}) cannot be loaded: {error}",
            code="plugin/not-loadable",
        ) from error


def _find_entry_point(group: str, name: str, kind: str) -> EntryPoint:
    """Return the entry point of a name. Raises ConfigError if there is none, or if packages disagree."""
    entries = list(_read_entry_points(*sys.path).select(group=group, name=name))
    if not entries:
        raise ConfigError(
            f"no {kind} called {shorten(name)!r} is installed; "
            f"{suggest_word(name, list_installed_plugins(group))}installed are "
            f"{', '.join(list_installed_plugins(group)) or 'none'}. "
            f"A package adds one by an entry point in the group {group!r}",
            code="plugin/not-found",
        )
    different_objects = {entry.value for entry in entries}
    if len(different_objects) > 1:
        packages = " and ".join(f"{_get_package_name(entry)} ({entry.value})" for entry in entries)
        raise ConfigError(
            f"{kind} {name!r} is in several installed packages: {packages}; uninstall all but one, or name a file "
            f"and a class in it, ./file.py:Class",
            code="plugin/ambiguous",
        )
    return entries[0]


def _get_package_name(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unknown package"


def _make_install_hint(entry: EntryPoint) -> str:
    """Return how to install what a plugin needs, if its entry point names its extras: `module:Class [extra]`."""
    if entry.dist is None or not entry.extras:
        return ""
    return f" Install it with: {make_pip_install_command(*entry.extras, package=entry.dist.name)}"


def make_pip_install_command(*extras: str, package: str = "snakesim") -> str:
    """Return the command that installs extras of a package in the environment of this process."""
    return f"{sys.executable} -m pip install '{package}[{','.join(extras)}]'"


def is_file_plugin(name: str) -> bool:
    """Return whether a name is the path of a Python file, with or without a class; loading it runs its code."""
    return ".py:" in name or name.endswith(".py")


def load_plugin_unless_file(group: str, name: str) -> Any | None:
    """Load an installed plugin. For a class in a file, only check that the class exists, and return None.

    The code of a file is not run.

    Raises:
        ConfigError: There is no such plugin, or it cannot be loaded.
    """
    if not is_file_plugin(name):
        return load_plugin(group, name)
    kind = _get_kind_name(group)
    _, attribute, tree = _parse_plugin_file(name, kind)
    defined_names = set(_iterate_defined_names(tree))
    # `from x import *` may define any name.
    if attribute not in defined_names and "*" not in defined_names:
        raise _make_missing_class_error(name, kind, tree)
    return None


def _get_kind_name(group: str) -> str:
    """Return what a plugin of a group is called in messages, such as `controller`."""
    return group.rpartition(".")[2].removesuffix("s")


def _split_plugin_name(name: str) -> tuple[str, str]:
    """Return file and class of `./file.py:Class`; the class is empty if the name has none."""
    if ".py:" not in name:
        return name, ""
    path, _, attribute = name.rpartition(":")
    return path, attribute


def _parse_plugin_file(name: str, kind: str) -> tuple[Path, str, ast.Module]:
    """Return the file, the class name, and the parsed code, which is not run. Raises ConfigError."""
    path_text, attribute = _split_plugin_name(name)
    try:
        path = expand_home(path_text).absolute()
        tree = ast.parse(read_bytes(path), str(path))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"{kind} {shorten(name)!r} cannot be loaded: {reason}", code="plugin/not-loadable"
        ) from None
    if not attribute:
        raise _make_missing_class_error(name, kind, tree)
    return path, attribute, tree


def _make_missing_class_error(name: str, kind: str, tree: ast.Module) -> ConfigError:
    """Return the error for a file without the class that a name asks for; it lists the classes in the file."""
    path, attribute = _split_plugin_name(name)
    classes = [statement.name for statement in tree.body if isinstance(statement, ast.ClassDef)]
    problem = f"the file has no {attribute!r}" if attribute else "the name of a class must follow"
    if classes:
        example = f"{path}:{classes[0]}"
        available = f"the classes in it are {', '.join(classes)}"
    else:
        example = f"{path}:Class"
        available = "there is no class in it"
    return ConfigError(
        f"{kind} {shorten(name)!r}: {problem}, as in {shorten(example)}; {shorten(available, 400)}",
        code="plugin/not-found",
    )


def _iterate_defined_names(tree: ast.Module) -> Iterator[str]:
    """Yield all names that a file may define."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.alias):
            yield node.asname or node.name
        elif isinstance(node, ast.Name):
            yield node.id


def _load_from_file(name: str, kind: str) -> Any:
    """Run a Python file, and return the class (or other object) that a plugin name asks for.

    The module stays in `sys.modules`, also if its code fails. From now on the file's imports also find modules in its
    own folder.

    Args:
        name: `./file.py:Class`.
        kind: What the plugin is called in errors, such as `controller`.

    Returns:
        The object of this name in the file, usually a class.

    Raises:
        ConfigError: The file cannot be run, or has no such class.
    """
    path, attribute, tree = _parse_plugin_file(name, kind)
    spec = importlib.util.spec_from_file_location(f"snakesim_plugin_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ConfigError(
            f"{kind} {name!r}: {path} cannot be loaded as Python", code="plugin/not-loadable"
        )
    module = importlib.util.module_from_spec(spec)
    # A dataclass looks for its module here while the file runs, and so does `pickle` later.
    sys.modules[spec.name] = module
    enable_sibling_imports(path)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"{kind} {shorten(name)!r} cannot be loaded: {type(error).__name__}: {error}",
            code="plugin/not-loadable",
        ) from error
    if not hasattr(module, attribute):
        raise _make_missing_class_error(name, kind, tree)
    return getattr(module, attribute)


def require_base_class(plugin: Any, base: type[BaseT], label: str) -> type[BaseT]:
    """Check that a plugin is a class that implements an interface, and return it.

    Args:
        plugin: Object that `load_plugin` has returned.
        base: Base class that declares the interface, such as `Controller`.
        label: Kind and name of the plugin, which the error begins with, such as "controller 'wave'".

    Raises:
        ConfigError: The plugin is not derived from the base class, or does not implement all of its abstract methods.
            The error names the class, its file, and what to write instead.
    """
    context = f"{label}: {describe_plugin(plugin)}"
    if not (isinstance(plugin, type) and issubclass(plugin, base)):
        class_name = plugin.__name__ if isinstance(plugin, type) else "Name"
        raise ConfigError(
            f"{context} does not derive from {base.__name__}. Write `class {class_name}({base.__name__}):`, after "
            f"`from {base.__module__} import {base.__name__}`",
            code="plugin/not-loadable",
        )
    missing = sorted(getattr(plugin, "__abstractmethods__", ()))
    if missing:
        methods = ", ".join(f"`{name}`" for name in missing)
        raise ConfigError(
            f"{context} has no {methods}: implement it as {base.__name__} in {base.__module__} describes",
            code="plugin/not-loadable",
        )
    return plugin


def describe_plugin(plugin: Any) -> str:
    """Return the kind, the name and the file of an object, as an error names it."""
    if not isinstance(plugin, type):
        return f"the object {shorten(repr(plugin))} (of class {type(plugin).__name__})"
    try:
        location = inspect.getfile(plugin)
    except (TypeError, OSError):  # such as a class of a notebook
        location = f"module {plugin.__module__}"
    return f"class {plugin.__name__} in {location}"


def decode_plugin_settings(
    plugin: Any,
    section: dict[str, Any],
    source: str,
    section_key: str,
    origin_by_key: dict[str, str] | None = None,
) -> Any:
    """Check the configuration section of a plugin, and convert it to the plugin's own Struct `Settings`.

    Args:
        plugin: Class with a Struct `Settings`.
        section: Values of the section as read.
        source: File that contains the section, for errors.
        section_key: Dotted key of the section, for errors.
        origin_by_key: File or flag that each value comes from, by dotted key. None if this is not known.

    Raises:
        ConfigError: The plugin has no `Settings`, or a value is not allowed.
    """
    settings_type = getattr(plugin, "Settings", None)
    if not (isinstance(settings_type, type) and issubclass(settings_type, msgspec.Struct)):
        raise ConfigError(
            f"{plugin!r} has no `Settings` Struct; every plugin needs one, even if it is empty",
            code="plugin/not-loadable",
        )
    return decode_table(
        ConfigTable(section, source, origin_by_key or {}), settings_type, section_key
    )
