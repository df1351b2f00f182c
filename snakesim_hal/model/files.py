"""Read configuration files: TOML (or JSON) in, a checked Struct out, otherwise one clear error.

An error names the file, the field, the value, its unit, what is allowed, and what to do. `Table` stores, for every
value, the file or flag that it came from.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from snakesim_hal.base.errors import ConfigError, did_you_mean, nearest, short
from snakesim_hal.model.field_types import Violation, first_violation, in_words, unit_of
from snakesim_hal.model.textfiles import MAX_DEPTH, parse_json, parse_toml, read_text

StructT = TypeVar("StructT", bound=msgspec.Struct)
SHIPPED = Path(__file__).parents[1] / "shipped"
ROUTER = SHIPPED / "router.json5"
SCHEMAS = Path(__file__).parents[1] / "schemas"  # in the repository a link to the folder beside the packages


class FileStruct(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Base of everything that is read from a file: an unknown field is an error, so that typos are not ignored."""


@dataclass
class Table:
    """Values as read, with the origin of each leaf; keys of `origin` are dotted."""

    values: dict[str, Any]
    source: str
    origin: dict[str, str] = field(default_factory=dict)

    def put(self, dotted: str, value: Any, origin: str) -> None:
        """Set a value, creating the parent tables."""
        *parents, last = dotted.split(".")
        if len(parents) >= MAX_DEPTH:
            raise ConfigError(f"{origin}: the key has {len(parents) + 1} parts, at most {MAX_DEPTH} are allowed")
        place: Any = self.values
        for i, name in enumerate(parents):
            if isinstance(place, list):
                place = _list_entry(place, name, ".".join(parents[: i + 1]), origin)
                continue
            place = place.setdefault(name, {})
            if not isinstance(place, dict | list):
                raise ConfigError(
                    f"{origin}: `{'.'.join(parents[: i + 1])}` is the value {short(repr(place))}, not a section; "
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
        """The file or flag that set a dotted key; `default` when none did."""
        key = dotted
        while key:
            if key in self.origin:
                return self.origin[key]
            key = key.rpartition(".")[0]
        return "default"

    def file_of(self, dotted: str) -> str:
        """The file that contains a field, or its nearest neighbors if it is missing."""
        place = dotted
        while place:
            for key, origin in self.origin.items():
                if (key == place or key.startswith(place + ".")) and not origin.startswith("--"):
                    return origin
            place = place.rpartition(".")[0]
        return self.source


def _origins(value: Any, origin: str, prefix: str = "") -> dict[str, str]:
    """An empty section sets nothing, so all its fields keep their defaults."""
    return {key: origin for key, leaf in leaves(value, prefix) if leaf != {}}


def _list_entry(place: list[Any], name: str, dotted: str, origin: str) -> Any:
    if not name.isdecimal() or len(name) > 9 or int(name) >= len(place):
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
    """Read a TOML or JSON file. Raises ConfigError when it is missing or not valid."""
    text = read_text(path)
    is_json = path.suffix == ".json" or text.startswith("{")  # which no TOML does; a file in memory has no suffix
    values = parse_json(text, str(path)) if is_json else parse_toml(text, str(path))
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: holds a {type(values).__name__}, not a table of settings")
    return Table(values, str(path), _origins(values, str(path)))


def find(name: str, kind: str, beside: Path | None = None) -> Path:
    """Path of a robot, scene or scenario: a path to a file (relative to `beside`), or the name of a shipped one.

    kind: `robots`, `scenes` or `scenarios`.
    """
    if name.endswith((".toml", ".json")) or "/" in name:
        path = expanded(name)
        return path if path.is_absolute() or beside is None else beside / path
    if name not in shipped(kind):
        raise ConfigError(f"no {kind[:-1]} called {short(name)!r}{_what_it_is(name, kind)}")
    return SHIPPED / kind / f"{name}.toml"


def _what_it_is(name: str, kind: str) -> str:
    """What a name may be that no shipped file of a kind has, and what to do."""
    if kind == "scenarios" and name.endswith(".py"):
        return f": it is Python. A controller of your own: --controller ./{short(name)}:CLASS, behind a scenario's name"
    for other in ("robots", "scenes"):
        if kind == "scenarios" and name in shipped(other):
            return f": it is a {other[:-1]}. Give a scenario, and --set {other[:-1]}={name}"
    return (
        f"; {did_you_mean(name, shipped(kind))}shipped are {', '.join(shipped(kind))}. For a file of your own give its "
        f"path, such as ./{short(name)}.toml"
    )


def read_part(name: str, kind: str, beside: Path | None = None, *, extended: tuple[Path, ...] = ()) -> Table:
    """Read a robot or a scene. With `extends = "planar13"` its file says only what differs from another one's.

    extended: the files that extend this one, which it cannot extend in turn.
    """
    path = find(name, kind, beside)
    if path.resolve() in extended:
        raise ConfigError(f"{path}: `extends` leads back to this file, so that none says what the robot or scene is")
    table = read_table(path)
    base = table.values.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise ConfigError(f"{path}: `extends` = {short(repr(base))} must be the name or the path of another file")
    whole = read_part(base, kind, path.parent, extended=(*extended, path.resolve()))
    for dotted, value in _settings(table.values):
        whole.put(dotted, value, str(path))
    return whole


def _settings(section: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value in a section and those in it; a list is one value."""
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _settings(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def expanded(name: str) -> Path:
    """A path, with `~` for the home folder. Raises ConfigError when there is no such home."""
    try:
        return Path(name).expanduser()
    except RuntimeError as error:
        raise ConfigError(f"{short(name)}: {error}") from None


def shipped(kind: str) -> list[str]:
    """Names of the shipped files of a kind."""
    return sorted(path.stem for path in (SHIPPED / kind).glob("*.toml"))


def decode(table: Table, struct: type[StructT], under: str = "") -> StructT:
    """Check a table against a Struct. Raises ConfigError naming file, field, value, unit and range."""
    try:
        return msgspec.convert(table.values, struct)
    except msgspec.ValidationError as error:
        violation = first_violation(table.values, struct)
        assert violation is not None, error
        raise ConfigError(_explain(violation, table, under)) from None
    except UnicodeEncodeError as error:  # JSON may escape, and a command line may hold, half of a character
        odd = ascii(error.object[error.start : error.end])[:40]
        raise ConfigError(
            f"{table.source}: a key or a text holds {odd}, which is not a character; write it again"
        ) from None


def _explain(violation: Violation, table: Table, under: str) -> str:
    *steps, name = [under, *violation.steps] if under else violation.steps or [""]
    dotted, whole = ".".join([*steps, short(name)]), ".".join([*steps, name])
    if violation.kind == "unknown":
        deeper = [short(key) for key in table.origin if key.endswith(f".{name}") and not key.startswith(whole)]
        close = nearest(name, violation.known) or next(iter(deeper), None)
        hint = f"did you mean `{close}`?" if close else f"known fields: {', '.join(sorted(violation.known))}."
        set_by = [origin for key, origin in table.origin.items() if key == dotted or key.startswith(dotted + ".")]
        return f"{set_by[0] if set_by else table.file_of(dotted)}: unknown field `{dotted}`; {hint}"
    info = msgspec.inspect.type_info(violation.wanted)
    if violation.kind == "missing":
        return f"{table.file_of(dotted)}: field `{dotted}` is missing; add it ({in_words(info)})."
    unit, value = unit_of(info), violation.value
    origin = table.origin_of(dotted)
    origin = table.file_of(dotted) if origin == "default" else origin
    if isinstance(value, dict) and not violation.why.startswith(
        "Expected"
    ):  # each field is right, together they are not
        return f"{origin}: `{dotted}`: {violation.why}" if dotted else f"{origin}: {violation.why}"
    shown = f"{short(_repr(value))}{' ' + unit if unit and isinstance(value, int | float) else ''}"
    why = "" if violation.why.startswith(("Expected `int", "Expected `float")) else f": {short(_lower(violation.why))}"
    return f"{origin}: `{dotted}` = {shown} is not allowed{why}; expected {in_words(info)}."


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]


def _repr(value: Any) -> str:
    try:
        return repr(value)
    except ValueError:  # Python does not print integers of more than 4300 digits
        return "a very large number"
