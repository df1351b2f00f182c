"""Reading the files that people write: TOML (or JSON) in, a checked Struct out, one clear error otherwise.

An error names the file, the field, the value, its unit, what is allowed, and what to do. `Table` keeps, for every
value, the file or flag that it came from.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from snakesim_hal.errors import ConfigError

StructT = TypeVar("StructT", bound=msgspec.Struct)
_AT = re.compile(r"^(?P<what>.*?)(?: - at `(?P<where>[^`]*)`)?$", re.DOTALL)
SHIPPED = Path(__file__).parent / "shipped"


class FileStruct(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Base of everything that is read from a file: an unknown field is an error, not a typo that does nothing."""


@dataclass
class Table:
    """Values as read, with the place that each leaf came from; keys of `origin` are dotted."""

    values: dict[str, Any]
    source: str
    origin: dict[str, str] = field(default_factory=dict)

    def put(self, dotted: str, value: Any, origin: str) -> None:
        """Set a value, making the tables on the way."""
        *parents, last = dotted.split(".")
        place: Any = self.values
        for i, name in enumerate(parents):
            if isinstance(place, list):
                place = _list_entry(place, name, ".".join(parents[: i + 1]), origin)
                continue
            place = place.setdefault(name, {})
            if not isinstance(place, dict | list):
                raise ConfigError(
                    f"{origin}: `{'.'.join(parents[: i + 1])}` is the value {place!r}, not a section; "
                    f"`{dotted}` cannot be set inside it"
                )
        if isinstance(place, list):
            _list_entry(place, last, dotted, origin)
            place[int(last)] = value
        else:
            place[last] = value
        for key in [k for k in self.origin if k == dotted or k.startswith(dotted + ".")]:
            del self.origin[key]
        self.origin.update(_origins(value, origin, dotted))

    def origin_of(self, dotted: str) -> str:
        """The file or flag behind a dotted key; `default` when nobody set it."""
        key = dotted
        while key:
            if key in self.origin:
                return self.origin[key]
            key = key.rpartition(".")[0]
        return "default"

    def file_of(self, dotted: str) -> str:
        """The file in which a field stands, or in which its nearest neighbours do when it is missing."""
        place = dotted
        while place:
            for key, origin in self.origin.items():
                if (key == place or key.startswith(place + ".")) and not origin.startswith("--"):
                    return origin
            place = place.rpartition(".")[0]
        return self.source


def _origins(value: Any, origin: str, prefix: str = "") -> dict[str, str]:
    """An empty section sets nothing, so everything in it is still a default."""
    return {key: origin for key, leaf in leaves(value, prefix) if leaf != {}}


def _list_entry(place: list[Any], name: str, dotted: str, origin: str) -> Any:
    if not name.isdigit() or int(name) >= len(place):
        has = f"has entries 0 to {len(place) - 1}; name one by its number" if place else "is empty"
        raise ConfigError(f"{origin}: `{dotted}`: the list {has}")
    return place[int(name)]


def leaves(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every leaf below a value as (dotted key, value); lists of tables are numbered from 0, other lists are leaves."""
    join = f"{prefix}." if prefix else ""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from leaves(inner, f"{join}{key}")
    elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
        for i, inner in enumerate(value):
            yield from leaves(inner, f"{join}{i}")
    else:
        yield prefix, value


def read_table(path: Path) -> Table:
    """Read a TOML or JSON file. Raises ConfigError when it is absent or no such file."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text: {error}") from error
    try:
        values = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid {path.suffix[1:].upper() or 'TOML'}: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: holds a {type(values).__name__}, not a table of settings")
    return Table(values, str(path), _origins(values, str(path)))


def find(name: str, kind: str, beside: Path | None = None) -> Path:
    """Path of a robot, scene or scenario: a path to a file (relative to `beside`), or the name of a shipped one.

    kind: `robots`, `scenes` or `scenarios`.
    """
    if name.endswith((".toml", ".json")) or "/" in name:
        path = Path(name).expanduser()
        return path if path.is_absolute() or beside is None else beside / path
    path = SHIPPED / kind / f"{name}.toml"
    if not path.is_file():
        raise ConfigError(
            f"no {kind[:-1]} called {name!r}; shipped are {', '.join(shipped(kind))}. "
            f"For a file of your own give its path, such as ./{name}.toml"
        )
    return path


def shipped(kind: str) -> list[str]:
    """Names of the shipped files of a kind."""
    return sorted(path.stem for path in (SHIPPED / kind).glob("*.toml"))


def decode(table: Table, struct: type[StructT], under: str = "") -> StructT:
    """Check a table against a Struct. Raises ConfigError naming file, field, value, unit and range."""
    try:
        return msgspec.convert(table.values, struct)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(error, table, struct, under)) from None


def _explain(error: msgspec.ValidationError, table: Table, struct: type[msgspec.Struct], under: str) -> str:
    match = _AT.match(str(error))
    assert match is not None
    what, where = match["what"], (match["where"] or "$").removeprefix("$").lstrip(".")
    steps = _steps(where, table.values, struct)
    dotted = ".".join(filter(None, [under, *steps]))
    unknown = re.match(r"Object contains unknown field `(.*)`", what)
    missing = re.match(r"Object missing required field `(.*)`", what)
    fields = _fields_at(struct, steps)
    if unknown:
        name = unknown[1]
        close = difflib.get_close_matches(name, fields, 1, 0.6)
        full = f"{dotted}.{name}" if dotted else name
        hint = f"did you mean `{close[0]}`?" if close else f"known here: {', '.join(sorted(fields))}."
        set_by = [origin for key, origin in table.origin.items() if key == full or key.startswith(full + ".")]
        return f"{set_by[0] if set_by else table.file_of(full)}: unknown field `{full}`; {hint}"
    if missing:
        name = missing[1]
        full = f"{dotted}.{name}" if dotted else name
        return f"{table.file_of(full)}: field `{full}` is missing; add it ({_wanted(fields.get(name))})."
    value: Any = table.values
    for step in steps:
        if isinstance(value, list | dict):
            value = value[int(step)] if isinstance(value, list) else value.get(step)
    info = fields_type(struct, steps)
    unit = _unit_of(info)
    origin = table.origin_of(dotted)
    origin = table.file_of(dotted) if origin == "default" else origin
    shown = f"{value!r}{' ' + unit if unit and isinstance(value, int | float) else ''}"
    return f"{origin}: `{dotted}` = {shown} is not allowed: {what[:1].lower() + what[1:]}; wanted is {_wanted(info)}."


def _steps(where: str, values: dict[str, Any], struct: type[msgspec.Struct]) -> list[str]:
    """The way to a wrong value. For a free key of a section msgspec says `[...]`: look which entry it is."""
    steps: list[str] = []
    value: Any = values
    for match in re.finditer(r"\[(\.\.\.|\d+)\]|[^.\[\]]+", where):
        step = match[1] or match[0]
        if step == "...":
            step = _wrong_entry(value, fields_type(struct, steps)) if isinstance(value, dict) else step
        steps.append(step)
        if isinstance(value, dict):
            value = value.get(step)
        elif isinstance(value, list) and step.isdigit() and int(step) < len(value):
            value = value[int(step)]
    return steps


def _wrong_entry(section: dict[str, Any], info: inspect.Type | None) -> str:
    wanted: Any = dict
    for option in _options(info):
        if isinstance(option, inspect.DictType) and isinstance(option.value_type, inspect.StructType):
            wanted = option.value_type.cls
    for key, value in section.items():
        try:
            msgspec.convert(value, wanted)
        except msgspec.ValidationError:
            return key
    return "..."


def _fields_at(struct: type[msgspec.Struct], steps: list[str]) -> dict[str, inspect.Type]:
    info = fields_type(struct, steps)
    for option in _options(info):
        if isinstance(option, inspect.StructType):
            return {f.encode_name: f.type for f in option.fields}
    return {}


def fields_type(struct: type[msgspec.Struct], steps: list[str]) -> inspect.Type | None:
    """The declared type at a path inside a Struct, as msgspec describes it."""
    info: inspect.Type | None = inspect.type_info(struct)
    for step in steps:
        following: inspect.Type | None = None
        for option in _options(info):
            if isinstance(option, inspect.StructType):
                following = next((f.type for f in option.fields if f.encode_name == step), None)
            elif isinstance(option, inspect.ListType):
                following = option.item_type
            elif isinstance(option, inspect.TupleType) and step.isdigit():
                following = option.item_types[int(step)] if int(step) < len(option.item_types) else None
            elif isinstance(option, inspect.DictType):
                following = option.value_type
            if following is not None:
                break
        info = following
    return info


def _options(info: inspect.Type | None) -> list[inspect.Type]:
    if info is None:
        return []
    if isinstance(info, inspect.Metadata):
        return _options(info.type)
    if isinstance(info, inspect.UnionType):
        return [leaf for option in info.types for leaf in _options(option)]
    return [info]


def _unit_of(info: inspect.Type | None) -> str:
    if isinstance(info, inspect.Metadata):
        return str((info.extra_json_schema or {}).get("unit", ""))
    return ""


def _wanted(info: inspect.Type | None) -> str:
    """What a field takes, in words."""
    unit = _unit_of(info)
    said: list[str] = []
    for option in _options(info):
        if isinstance(option, inspect.FloatType | inspect.IntType):
            word = "a number" if isinstance(option, inspect.FloatType) else "a whole number"
            bounds = [
                f"{sign} {bound:g}"
                for sign, bound in ((">=", option.ge), (">", option.gt), ("<=", option.le), ("<", option.lt))
                if bound is not None
            ]
            said.append(" ".join(filter(None, [word, " and ".join(bounds), f"in {unit}" if unit else ""])))
        elif isinstance(option, inspect.LiteralType):
            said.append("one of " + ", ".join(repr(v) for v in option.values))
        elif isinstance(option, inspect.StrType):
            said.append("a text")
        elif isinstance(option, inspect.BoolType):
            said.append("true or false")
        elif isinstance(option, inspect.StructType):
            said.append("a section with " + ", ".join(f.encode_name for f in option.fields))
        elif isinstance(option, inspect.ListType):
            said.append(f"a list, each {_wanted(option.item_type)}")
        elif isinstance(option, inspect.TupleType):
            said.append(f"{len(option.item_types)} values, each {_wanted(option.item_types[0])}")
        elif isinstance(option, inspect.DictType):
            said.append("a section")
    return " or ".join(said) or "another value"
