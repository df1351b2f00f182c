"""Read configuration files: TOML (or JSON) in, a checked Struct out, otherwise one clear error.

An error names the file, the field, the value, its unit, what is allowed, and what to do. `Table` stores, for every
value, the file or flag that it came from.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import msgspec

from snakesim_hal.base.errors import ConfigError, find_nearest_word, shorten, suggest_word
from snakesim_hal.model.field_types import Violation, first_violation, in_words, unit_of
from snakesim_hal.model.textfiles import MAX_DEPTH, parse_json, parse_toml, read_text

StructT = TypeVar("StructT", bound=msgspec.Struct)
SHIPPED = Path(__file__).parents[1] / "shipped"
ROUTER = SHIPPED / "router.json5"
SCHEMAS = Path(__file__).parents[1] / "schemas"  # in the repository a link to the folder beside the packages
MAX_INDEX_DIGITS = 9  # Python converts longer numbers slowly, and no list is that long
MAX_SHOWN_TEXT = 40  # characters of a damaged text in an error


class FileStruct(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Base of everything that is read from a file: an unknown field is an error, so that typos are not ignored."""

    # Sections for all to which this one contains exceptions: it has their fields, and None means the value for all.
    exceptions_to: ClassVar[tuple[type[msgspec.Struct], ...]] = ()


@dataclass
class Table:
    """Values as read, with the origin of each leaf."""

    values: dict[str, Any]
    source: str  # the file
    origin: dict[str, str] = field(default_factory=dict)  # dotted key -> file or flag

    def set_value(self, dotted: str, value: Any, origin: str) -> None:
        """Set a value, and create the sections above it.

        Args:
            dotted: key, such as `scene.ground.friction`; an entry of a list is named by its number.
            value: any value of a TOML file.
            origin: file or flag that gives the value.

        Raises:
            ConfigError: There is no such entry of a list, or a part of the key is a value and not a section.
        """
        *parents, last = dotted.split(".")
        if len(parents) >= MAX_DEPTH:
            raise ConfigError(
                f"{origin}: the key has {len(parents) + 1} parts, at most {MAX_DEPTH} are allowed",
                code="config/unknown-key",
            )
        section = self._section_for(dotted, parents, origin)
        if isinstance(section, list):
            index = _list_index(section, last, dotted, origin)
            section[index] = value
        else:
            section[last] = value
        replaced = [key for key in self.origin if key == dotted or key.startswith(dotted + ".")]
        for key in replaced:
            del self.origin[key]
        self.origin.update(_origins(value, origin, dotted))

    def _section_for(self, dotted: str, parents: list[str], origin: str) -> Any:
        """Return the dict or list that the parents of a key lead to; sections that are missing are created."""
        section: Any = self.values
        for i, name in enumerate(parents):
            path = ".".join(parents[: i + 1])
            if isinstance(section, list):
                section = section[_list_index(section, name, path, origin)]
                continue
            section = section.setdefault(name, {})
            if not isinstance(section, dict | list):
                raise ConfigError(
                    f"{origin}: `{path}` is the value {shorten(repr(section))}, not a section; "
                    f"`{dotted}` cannot be set inside it",
                    code="config/unknown-key",
                )
        return section

    def origin_of(self, dotted: str) -> str:
        """Return the file or flag that gives the value of a dotted key; `default` if none does."""
        key = dotted
        while key:
            if key in self.origin:
                return self.origin[key]
            key = key.rpartition(".")[0]
        return "default"

    def file_of(self, dotted: str) -> str:
        """Return the file that contains a field, or its nearest neighbors if the field is missing."""
        section = dotted
        while section:
            for key, origin in self.origin.items():
                is_inside = key == section or key.startswith(section + ".")
                is_flag = origin.startswith("--")
                if is_inside and not is_flag:
                    return origin
            section = section.rpartition(".")[0]
        return self.source


def _origins(value: Any, origin: str, prefix: str = "") -> dict[str, str]:
    """Return the origin of every leaf below a value; an empty section has none, as its fields keep their defaults."""
    return {key: origin for key, leaf in leaves(value, prefix) if leaf != {}}


def _list_index(entries: list[Any], name: str, dotted: str, origin: str) -> int:
    """Return the index of the entry that a part of a dotted key names. Raises ConfigError if there is none."""
    is_number = name.isdecimal() and len(name) <= MAX_INDEX_DIGITS
    if is_number and int(name) < len(entries):
        return int(name)
    if not entries:
        raise ConfigError(f"{origin}: `{dotted}`: the list is empty", code="config/unknown-key")
    raise ConfigError(
        f"{origin}: `{dotted}`: the list has entries 0 to {len(entries) - 1}; name one by its number",
        code="config/unknown-key",
    )


def leaves(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every leaf below a value as (dotted key, value).

    Entries of a list of tables are numbered from 0; any other list is one leaf, and so is an empty section.
    """
    path = f"{prefix}." if prefix else ""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from leaves(inner, f"{path}{key}")
    elif isinstance(value, list) and value and all(isinstance(entry, dict) for entry in value):
        for i, inner in enumerate(value):
            yield from leaves(inner, f"{path}{i}")
    else:
        yield prefix, value


def read_table(path: Path) -> Table:
    """Read a TOML or JSON file.

    Raises:
        ConfigError: The file is missing or not valid.
    """
    text = read_text(path)
    # No TOML file begins with a brace. A file in memory has no suffix.
    is_json = path.suffix == ".json" or text.startswith("{")
    parse = parse_json if is_json else parse_toml
    values = parse(text, str(path))
    if not isinstance(values, dict):
        raise ConfigError(
            f"{path}: holds a {type(values).__name__}, not a table of settings", code="file/invalid-syntax"
        )
    return Table(values, str(path), _origins(values, str(path)))


def find_file(name: str, kind: str, beside: Path | None = None) -> Path:
    """Return the path of a robot, scene or scenario file.

    Args:
        name: of a shipped file, or the path of any file.
        kind: `robots`, `scenes` or `scenarios`.
        beside: folder that a relative path starts from; None: the working folder.

    Raises:
        ConfigError: There is no shipped file of that name.
    """
    if name.endswith((".toml", ".json")) or "/" in name:
        path = expand_home(name)
        if path.is_absolute() or beside is None:
            return path
        return beside / path
    if name not in list_shipped(kind):
        raise ConfigError(
            f"no {kind[:-1]} called {shorten(name)!r}{_hint_for_unknown(name, kind)}", code="config/unknown-name"
        )
    return SHIPPED / kind / f"{name}.toml"


def _hint_for_unknown(name: str, kind: str) -> str:
    """Return what the user may mean by a name that no shipped file of a kind has, and what to do."""
    if kind == "scenarios" and name.endswith(".py"):
        return (
            f": it is Python. A controller of your own: --controller ./{shorten(name)}:CLASS, behind a scenario's name"
        )
    for other in ("robots", "scenes"):
        if kind == "scenarios" and name in list_shipped(other):
            return f": it is a {other[:-1]}. Give a scenario, and --set {other[:-1]}={name}"
    return (
        f"; {suggest_word(name, list_shipped(kind))}shipped are {', '.join(list_shipped(kind))}. For a file "
        "of your own give its "
        f"path, such as ./{shorten(name)}.toml"
    )


def read_part(name: str, kind: str, beside: Path | None = None, *, extended: tuple[Path, ...] = ()) -> Table:
    """Read a robot or scene file, merged into the file that it extends, if any.

    A file with `extends = "planar13"` contains only what differs from that robot.

    Args:
        name: of a shipped file, or the path of any file.
        kind: `robots` or `scenes`.
        beside: folder that a relative path starts from; None: the working folder.
        extended: the files that extend this one, directly or indirectly; this file must not extend them in turn.

    Returns:
        All values, each with the file that it comes from.

    Raises:
        ConfigError: A file is missing or not valid, or files extend each other.
    """
    path = find_file(name, kind, beside)
    if path.resolve() in extended:
        raise ConfigError(
            f"{path}: `extends` leads back to this file; remove `extends` from one file of this chain",
            code="config/conflict",
        )
    table = read_table(path)
    base = table.values.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise ConfigError(f"{path}: `extends` = {shorten(repr(base))} must be the name or the path of another file")
    merged = read_part(base, kind, path.parent, extended=(*extended, path.resolve()))
    for dotted_key, value in _settings(table.values):
        merged.set_value(dotted_key, value, str(path))
    return merged


def _settings(section: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value in a section, and in the sections inside of it, as (dotted key, value); a list is one value."""
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _settings(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def expand_home(name: str) -> Path:
    """Return a path in which `~` is replaced by the home folder. Raises ConfigError if there is no such home."""
    try:
        return Path(name).expanduser()
    except RuntimeError as error:
        raise ConfigError(f"{shorten(name)}: {error}", code="file/not-found") from None


def list_shipped(kind: str) -> list[str]:
    """Return the names of the shipped files of a kind: `robots`, `scenes` or `scenarios`."""
    return sorted(path.stem for path in (SHIPPED / kind).glob("*.toml"))


def decode(table: Table, struct: type[StructT], under: str = "") -> StructT:
    """Check a table against a Struct, and return the Struct.

    Args:
        table: values as read.
        struct: the type that they must have.
        under: dotted key of the section that the table is, for errors.

    Raises:
        ConfigError: A value is not allowed. The error names file, field, value, unit and range.
    """
    try:
        return msgspec.convert(table.values, struct)
    except msgspec.ValidationError as error:
        violation = first_violation(table.values, struct)
        assert violation is not None, error
        raise ConfigError(_explain(violation, table, under), code=_choose_code(violation)) from None
    except UnicodeEncodeError as error:  # JSON may escape, and a command line may hold, half of a character
        invalid_text = ascii(error.object[error.start : error.end])[:MAX_SHOWN_TEXT]
        raise ConfigError(
            f"{table.source}: a key or a text holds {invalid_text}, which is not a character; write it again"
        ) from None


def _choose_code(violation: Violation) -> str:
    """Return the code of the error about a violation."""
    match violation.kind:
        case "unknown":
            return "config/unknown-key"
        case "missing":
            return "config/missing-key"
        case "wrong":
            is_number = isinstance(violation.value, int | float) and not isinstance(violation.value, bool)
            is_outside = is_number and (">" in violation.why or "<" in violation.why)  # as msgspec writes ranges
            return "config/out-of-range" if is_outside else "config/invalid-value"


def _explain(violation: Violation, table: Table, under: str) -> str:
    """Return the error text for a violation."""
    if under:
        *steps, name = [under, *violation.steps]
    else:
        *steps, name = violation.steps or [""]
    dotted = ".".join([*steps, shorten(name)])
    match violation.kind:
        case "unknown":
            full_key = ".".join([*steps, name])
            return _explain_unknown(violation, table, dotted, full_key)
        case "missing":
            expected = in_words(msgspec.inspect.type_info(violation.expected))
            return f"{table.file_of(dotted)}: field `{dotted}` is missing; add it ({expected})."
        case "wrong":
            return _explain_wrong(violation, table, dotted)


def _explain_unknown(violation: Violation, table: Table, dotted: str, full_key: str) -> str:
    """Return the error text for an unknown field.

    It suggests a field of the same section with a similar name, or else the same name in another section.

    Args:
        violation: kind `unknown`.
        table: values as read.
        dotted: key of the field, shortened for display.
        full_key: the whole key of the field.
    """
    name = violation.steps[-1]
    suggestion = find_nearest_word(name, violation.known)
    if not suggestion:
        same_name_keys = [key for key in table.origin if key.endswith(f".{name}") and not key.startswith(full_key)]
        if same_name_keys:
            suggestion = shorten(same_name_keys[0])
    hint = f"known fields: {', '.join(sorted(violation.known))}."
    if suggestion:
        hint = f"did you mean `{suggestion}`?"
    origins = [origin for key, origin in table.origin.items() if key == dotted or key.startswith(dotted + ".")]
    origin = origins[0] if origins else table.file_of(dotted)
    return f"{origin}: unknown field `{dotted}`; {hint}"


def _explain_wrong(violation: Violation, table: Table, dotted: str) -> str:
    """Return the error text for a value that is not allowed.

    Args:
        violation: the value, the type that is expected, and the error of msgspec.
        table: all values with their origins.
        dotted: dotted key of the value; empty for the whole file.
    """
    value = violation.value
    why = violation.why
    origin = table.origin_of(dotted)
    if origin == "default":
        origin = table.file_of(dotted)

    # A section whose fields all have the right type can still fail the check of the section as a whole.
    section_check_failed = isinstance(value, dict) and not why.startswith("Expected")
    if section_check_failed:
        return f"{origin}: `{dotted}`: {why}" if dotted else f"{origin}: {why}"

    info = msgspec.inspect.type_info(violation.expected)
    unit = unit_of(info)
    shown = shorten(_repr(value))
    if unit and isinstance(value, int | float):
        shown += f" {unit}"
    reason = ""
    if not why.startswith(("Expected `int", "Expected `float")):  # the expected range explains more
        reason = f": {shorten(_lower_first(why))}"
    return f"{origin}: `{dotted}` = {shown} is not allowed{reason}; expected {in_words(info)}."


def _lower_first(text: str) -> str:
    return text[:1].lower() + text[1:]


def _repr(value: Any) -> str:
    """Return the repr of a value; Python refuses to print integers of more than 4300 digits."""
    try:
        return repr(value)
    except ValueError:
        return "a very large number"
