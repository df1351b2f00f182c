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
from snakesim_hal.model.files import Table, decode, expand_home
from snakesim_hal.model.sibling_modules import find_siblings_of
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
_offered: dict[tuple[str, str], Any] = {}


@contextlib.contextmanager
def offer_plugin(group: str, name: str, plugin: Any) -> Iterator[None]:
    """Register an object as a plugin in this process, for as long as the context lasts.

    It has precedence over an installed plugin of the same name.

    Args:
        group: one of the groups of entry points.
        name: of the plugin.
        plugin: the object that `find_plugin` returns for the name.
    """
    previously_offered = _offered.copy()
    _offered[group, name] = plugin
    try:
        yield
    finally:
        _offered.clear()
        _offered.update(previously_offered)


def anything_offered() -> bool:
    """Return whether this process has a plugin that no other process could find."""
    return bool(_offered)


def list_installed(group: str) -> list[str]:
    """Return the names of all installed plugins of a group."""
    return sorted({entry.name for entry in _installed(*sys.path).select(group=group)})


@cache
def _installed(*_path: str) -> EntryPoints:
    """Return every entry point on a path. Reading them takes 7 ms, and a run looks up a dozen, so they are cached."""
    all_entries: Any = entry_points()  # before Python 3.12 of another class, which has the same `select`
    return all_entries


def find_plugin(group: str, name: str) -> Any:
    """Return the plugin of a name. A file is loaded, which runs its code.

    Args:
        group: one of the groups of entry points.
        name: of an entry point, or `./file.py:Class`.

    Raises:
        ConfigError: There is no such plugin, or it cannot be loaded. The error lists the installed plugins.
    """
    kind = _kind(group)
    if (group, name) in _offered:
        return _offered[group, name]
    if in_file(name):
        return _from_file(name, kind)
    entry = _find_entry(group, name, kind)
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{kind} {name!r} cannot be loaded: {error}.{_install_hint(entry)}", code="extra/not-installed"
        ) from error
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{kind} {name!r} ({entry.value}) cannot be loaded: {error}", code="plugin/not-loadable"
        ) from error


def _find_entry(group: str, name: str, kind: str) -> EntryPoint:
    """Return the only entry point of a name. Raises ConfigError if there is none, or if packages disagree."""
    entries = list(_installed(*sys.path).select(group=group, name=name))
    if not entries:
        raise ConfigError(
            f"no {kind} called {shorten(name)!r} is installed; "
            f"{suggest_word(name, list_installed(group))}installed are "
            f"{', '.join(list_installed(group)) or 'none'}. "
            f"A package adds one by an entry point in the group {group!r}",
            code="plugin/not-found",
        )
    different_objects = {entry.value for entry in entries}
    if len(different_objects) > 1:
        packages = " and ".join(f"{_package(entry)} ({entry.value})" for entry in entries)
        raise ConfigError(
            f"{kind} {name!r} is in several installed packages: {packages}; uninstall all but one, or name a file "
            f"and a class in it, ./file.py:Class",
            code="plugin/ambiguous",
        )
    return entries[0]


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unknown package"


def _install_hint(entry: EntryPoint) -> str:
    """Return how to install what a plugin needs, if its entry point names its extras: `module:Class [extra]`."""
    if entry.dist is None or not entry.extras:
        return ""
    return f" Install it with: {pip_install(*entry.extras, package=entry.dist.name)}"


def pip_install(*extras: str, package: str = "snakesim") -> str:
    """Return the command that installs extras of a package in the environment of this process."""
    return f"{sys.executable} -m pip install '{package}[{','.join(extras)}]'"


def in_file(name: str) -> bool:
    """Return whether a name is the path of a Python file, with or without a class; loading it runs its code."""
    return ".py:" in name or name.endswith(".py")


def find_installed(group: str, name: str) -> Any | None:
    """Return an installed plugin; for a file only check that the class exists, without running it, and return None.

    Raises:
        ConfigError: There is no such plugin, or it cannot be loaded.
    """
    if not in_file(name):
        return find_plugin(group, name)
    kind = _kind(group)
    _, attribute, tree = _parse_file(name, kind)
    defined = set(_names(tree))
    if attribute not in defined and "*" not in defined:  # `from x import *` may define any name
        raise _missing_class_error(name, kind, tree)
    return None


def _kind(group: str) -> str:
    """Return what a plugin of a group is called in messages, such as `controller`."""
    return group.rpartition(".")[2].removesuffix("s")


def _split_name(name: str) -> tuple[str, str]:
    """Return file and class of `./file.py:Class`; the class is empty if the name has none."""
    if ".py:" not in name:
        return name, ""
    path, _, attribute = name.rpartition(":")
    return path, attribute


def _parse_file(name: str, kind: str) -> tuple[Path, str, ast.Module]:
    """Return the file, the class name, and the parsed code, which is not run. Raises ConfigError."""
    path_text, attribute = _split_name(name)
    try:
        path = expand_home(path_text).absolute()
        tree = ast.parse(read_bytes(path), str(path))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        why = error if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        raise ConfigError(f"{kind} {shorten(name)!r} cannot be loaded: {why}", code="plugin/not-loadable") from None
    if not attribute:
        raise _missing_class_error(name, kind, tree)
    return path, attribute, tree


def _missing_class_error(name: str, kind: str, tree: ast.Module) -> ConfigError:
    """Return the error for a file without the class that a name asks for; it lists the classes in the file."""
    path, attribute = _split_name(name)
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


def _names(tree: ast.Module) -> Iterator[str]:
    """Yield all names that a file may define."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.alias):
            yield node.asname or node.name
        elif isinstance(node, ast.Name):
            yield node.id


def _from_file(name: str, kind: str) -> Any:
    """Run a Python file, and return the object that a name asks for. Raises ConfigError."""
    path, attribute, tree = _parse_file(name, kind)
    spec = importlib.util.spec_from_file_location(f"snakesim_plugin_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{kind} {name!r}: {path} cannot be loaded as Python", code="plugin/not-loadable")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    find_siblings_of(path)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"{kind} {shorten(name)!r} cannot be loaded: {type(error).__name__}: {error}", code="plugin/not-loadable"
        ) from error
    if not hasattr(module, attribute):
        raise _missing_class_error(name, kind, tree)
    return getattr(module, attribute)


def require_base_class(plugin: Any, base: type[BaseT], label: str) -> type[BaseT]:
    """Return a plugin that is a class derived from a base class, and that implements its abstract methods.

    Args:
        plugin: the object that `find_plugin` has returned.
        base: the class that describes the interface, such as `Controller`.
        label: kind and name of the plugin, with which the error begins, such as "controller 'wave'".

    Raises:
        ConfigError: it is not. The text names the class, its file, and what to write instead.
    """
    where = f"{label}: {describe_plugin(plugin)}"
    if not (isinstance(plugin, type) and issubclass(plugin, base)):
        class_name = plugin.__name__ if isinstance(plugin, type) else "Name"
        raise ConfigError(
            f"{where} does not derive from {base.__name__}. Write `class {class_name}({base.__name__}):`, after "
            f"`from {base.__module__} import {base.__name__}`",
            code="plugin/not-loadable",
        )
    missing = sorted(getattr(plugin, "__abstractmethods__", ()))
    if missing:
        methods = ", ".join(f"`{name}`" for name in missing)
        raise ConfigError(
            f"{where} has no {methods}: implement it as {base.__name__} in {base.__module__} describes",
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


def plugin_settings(
    plugin: Any, section: dict[str, Any], source: str, where: str, origin: dict[str, str] | None = None
) -> Any:
    """Return a plugin's section of the configuration, checked by the plugin's own `Settings`.

    Args:
        plugin: a class with a Struct `Settings`.
        section: the values as read.
        source: file that contains them, for errors.
        where: dotted key of the section, for errors.
        origin: file or flag of each dotted key, as far as known.

    Raises:
        ConfigError: The plugin has no `Settings`, or a value is not allowed.
    """
    settings = getattr(plugin, "Settings", None)
    if not (isinstance(settings, type) and issubclass(settings, msgspec.Struct)):
        raise ConfigError(
            f"{plugin!r} has no `Settings` Struct; every plugin needs one, even if it is empty",
            code="plugin/not-loadable",
        )
    return decode(Table(section, source, origin or {}), settings, where)
