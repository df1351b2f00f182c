"""Find backends, controllers and services by name: an entry point of an installed package, or a file.

`wave` is looked up among the entry points; `./wave.py:Wave` is the object `Wave` of that file, for development.
A program that runs everything in one process may offer objects of its own.
"""

import ast
import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, did_you_mean, short
from snakesim_hal.model.files import Table, decode, expanded
from snakesim_hal.model.sibling_modules import find_siblings_of
from snakesim_hal.model.textfiles import read_bytes

BACKENDS = "snakesim.backends"
COMMANDS = "snakesim.commands"
CONTROLLERS = "snakesim.controllers"
FILMS = "snakesim.films"
PLANTS = "snakesim.physics_models"
SENSORS = "snakesim.sensors"
SERVICES = "snakesim.services"
_offered: dict[tuple[str, str], Any] = {}


@contextlib.contextmanager
def offered(group: str, name: str, plugin: Any) -> Iterator[None]:
    """Have a name stand for an object, in this process and as long as the context lives, whatever is installed."""
    before = _offered.copy()
    _offered[group, name] = plugin
    try:
        yield
    finally:
        _offered.clear()
        _offered.update(before)


def anything_offered() -> bool:
    """Whether this process has a plugin that no other one could find."""
    return bool(_offered)


def installed(group: str) -> list[str]:
    """Names of all installed plugins of a group."""
    return sorted({entry.name for entry in _installed(*sys.path).select(group=group)})


@cache
def _installed(*_path: str) -> EntryPoints:
    """Every entry point on a path: reading them anew takes 7 ms, and a run looks up a dozen."""
    found: Any = entry_points()  # before Python 3.12 of another class, which has the same `select`
    return found


def find_plugin(group: str, name: str) -> Any:
    """Load the plugin of a name. Raises ConfigError that lists the installed ones."""
    kind = _kind(group)
    if (group, name) in _offered:
        return _offered[group, name]
    if in_file(name):
        return _from_file(name, kind)
    found = list(_installed(*sys.path).select(group=group, name=name))
    if not found:
        raise ConfigError(
            f"no {kind} called {short(name)!r} is installed; {did_you_mean(name, installed(group))}installed are "
            f"{', '.join(installed(group)) or 'none'}. "
            f"A package adds one by an entry point in the group {group!r}"
        )
    entry = found[0]
    if len({one.value for one in found}) > 1:
        packages = " and ".join(f"{_package(one)} ({one.value})" for one in found)
        raise ConfigError(
            f"{kind} {name!r} is in several installed packages: {packages}; uninstall all but one, or name a file "
            f"and a class in it, ./file.py:Class"
        )
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        raise ConfigError(f"{kind} {name!r} cannot be loaded: {error}.{_extras_of(entry)}") from error
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{kind} {name!r} ({entry.value}) cannot be loaded: {error}") from error


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unknown package"


def _extras_of(entry: EntryPoint) -> str:
    """How to install what a plugin needs, if its entry point names its extras: `module:Class [extra]`."""
    if entry.dist is None or not entry.extras:
        return ""
    return f" Install it with: {pip_install(*entry.extras, package=entry.dist.name)}"


def pip_install(*extras: str, package: str = "snakesim") -> str:
    """The command that adds extras to this very environment."""
    return f"{sys.executable} -m pip install '{package}[{','.join(extras)}]'"


def in_file(name: str) -> bool:
    """Whether a name is the path of a Python file, with or without a class; loading it runs its code."""
    return ".py:" in name or name.endswith(".py")


def find_installed(group: str, name: str) -> Any | None:
    """Like `find_plugin`; but for a file it only checks that the class exists, without running it, and returns None."""
    if not in_file(name):
        return find_plugin(group, name)
    kind = _kind(group)
    _, attribute, tree = _parsed(name, kind)
    if not {attribute, "*"} & set(_names(tree)):
        raise _not_there(name, kind, tree)
    return None


def _kind(group: str) -> str:
    return group.rpartition(".")[2].removesuffix("s")


def _parsed(name: str, kind: str) -> tuple[Path, str, ast.Module]:
    """The file, the name in it, and its parsed code, which is not run."""
    path_text, _, attribute = (name if ".py:" in name else f"{name}:").rpartition(":")
    try:
        path = expanded(path_text).absolute()
        tree = ast.parse(read_bytes(path), str(path))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        why = error if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        raise ConfigError(f"{kind} {short(name)!r} cannot be loaded: {why}") from None
    if not attribute:
        raise _not_there(name, kind, tree)
    return path, attribute, tree


def _not_there(name: str, kind: str, tree: ast.Module) -> ConfigError:
    path, _, attribute = (name if ".py:" in name else f"{name}:").rpartition(":")
    classes = [part.name for part in tree.body if isinstance(part, ast.ClassDef)]
    what = f"the file has no {attribute!r}" if attribute else "the name of a class must follow"
    has = f"the classes in it are {', '.join(classes)}" if classes else "there is no class in it"
    example = f"{path}:{classes[0] if classes else 'Class'}"
    return ConfigError(f"{kind} {short(name)!r}: {what}, as in {short(example)}; {short(has, 400)}")


def _names(tree: ast.Module) -> Iterator[str]:
    """All names that the file may define."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.alias):
            yield node.asname or node.name
        elif isinstance(node, ast.Name):
            yield node.id


def _from_file(name: str, kind: str) -> Any:
    path, attribute, tree = _parsed(name, kind)
    spec = importlib.util.spec_from_file_location(f"snakesim_plugin_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{kind} {name!r}: {path} cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    find_siblings_of(path)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{kind} {short(name)!r} cannot be loaded: {type(error).__name__}: {error}") from error
    if not hasattr(module, attribute):
        raise _not_there(name, kind, tree)
    return getattr(module, attribute)


def plugin_settings(
    plugin: Any, section: dict[str, Any], source: str, where: str, origin: dict[str, str] | None = None
) -> Any:
    """A plugin's section of the configuration, checked by its own `Settings`.

    source, origin: the file, and the known origin of each of its dotted keys.
    """
    settings = getattr(plugin, "Settings", None)
    if not (isinstance(settings, type) and issubclass(settings, msgspec.Struct)):
        raise ConfigError(f"{plugin!r} has no `Settings` Struct; every plugin needs one, even if it is empty")
    return decode(Table(section, source, origin or {}), settings, where)
