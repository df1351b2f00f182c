"""Read configuration files: TOML (or JSON) in, a checked Struct out, otherwise one clear error.

An error names the file, the field, the value, its unit, what is allowed, and what to do. `ConfigTable` stores, for
every value, the file or flag that it came from.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import msgspec

from snakesim_hal.base.errors import ConfigError, find_nearest_word, shorten, suggest_word
from snakesim_hal.model.fields.field_types import (
    TypeViolation,
    describe_type_in_words,
    find_declared_unit,
    find_first_violation,
)
from snakesim_hal.model.textfiles import MAX_DEPTH, parse_json, parse_toml, read_text

StructT = TypeVar("StructT", bound=msgspec.Struct)
SHIPPED_FILES_DIR = Path(__file__).parents[1] / "shipped"
ROUTER_CONFIG_PATH = SHIPPED_FILES_DIR / "router.json5"
# In the repository a link to the folder beside the packages.
SCHEMAS_DIR = Path(__file__).parents[1] / "schemas"
# Kinds of shipped files: the name of the folder, and of one file.
SINGULAR_BY_KIND = {
    "robots": "robot",
    "scenes": "scene",
    "scenarios": "scenario",
    "suites": "suite",
}
MAX_LIST_INDEX_DIGITS = 9  # Python converts longer numbers slowly, and no list is that long
MAX_SHOWN_TEXT = 40  # characters of a damaged text in an error


class FileStruct(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Base of everything that is read from a file: an unknown field is an error, so that typos are not ignored."""

    # Sections for all to which this one contains exceptions: it has their fields, and None means the value for all.
    exceptions_to: ClassVar[tuple[type[msgspec.Struct], ...]] = ()


@dataclass
class ConfigTable:
    """Configuration values as read, with the file or flag that each value comes from (its origin)."""

    values: dict[str, Any]
    source: str  # path of the main file
    origin_by_key: dict[str, str] = field(default_factory=dict)  # dotted key -> file or flag

    def set_value(self, dotted_key: str, value: Any, origin: str) -> None:
        """Set a value and its origin. Missing sections above the value are created.

        Args:
            dotted_key: Key of the value, such as `scene.ground.friction`. An entry of a list is named by its index.
            value: Any value that a TOML file can hold, or a whole section.
            origin: File or flag that the value comes from.

        Raises:
            ConfigError: A list index is out of range, the key has too many parts, or a part of it leads to a value that
                is not a section.
        """
        *parents, last_name = dotted_key.split(".")
        if len(parents) >= MAX_DEPTH:
            raise ConfigError(
                f"{origin}: the key has {len(parents) + 1} parts, at most {MAX_DEPTH} are allowed",
                code="config/unknown-key",
            )
        section = self._find_or_create_section(dotted_key, parents, origin)
        if isinstance(section, list):
            index = _parse_list_index(section, last_name, dotted_key, origin)
            section[index] = value
        else:
            section[last_name] = value
        # The value replaces a whole section, so the origins of the former values below it are stale.
        stale_keys = [
            key
            for key in self.origin_by_key
            if key == dotted_key or key.startswith(dotted_key + ".")
        ]
        for key in stale_keys:
            del self.origin_by_key[key]
        self.origin_by_key.update(_collect_origins(value, origin, dotted_key))

    def _find_or_create_section(self, dotted_key: str, parents: list[str], origin: str) -> Any:
        """Return the dict or list that contains the value of a key. Missing sections are created.

        Args:
            dotted_key: Whole key, for errors.
            parents: Parts of the key without the last one.
            origin: File or flag that the value comes from, for errors.

        Raises:
            ConfigError: A part of the key leads to a value that is not a section, or a list index is out of range.
        """
        section: Any = self.values
        for depth, name in enumerate(parents, start=1):
            path = ".".join(parents[:depth])
            if isinstance(section, list):
                section = section[_parse_list_index(section, name, path, origin)]
                continue
            section = section.setdefault(name, {})
            if not isinstance(section, dict | list):
                raise ConfigError(
                    f"{origin}: `{path}` is the value {shorten(repr(section))}, not a section; "
                    f"`{dotted_key}` cannot be set inside it",
                    code="config/unknown-key",
                )
        return section

    def find_origin(self, dotted_key: str) -> str:
        """Return the file or flag that gives the value of a dotted key; `default` if none does."""
        key = dotted_key
        while key:
            if key in self.origin_by_key:
                return self.origin_by_key[key]
            key = key.rpartition(".")[0]
        return "default"

    def find_source_file(self, dotted_key: str) -> str:
        """Return the file that contains a field, or its nearest neighbors if the field is missing."""
        section = dotted_key
        while section:
            for key, origin in self.origin_by_key.items():
                is_inside = key == section or key.startswith(section + ".")
                is_flag = origin.startswith("--")
                if is_inside and not is_flag:
                    return origin
            section = section.rpartition(".")[0]
        return self.source


def _collect_origins(value: Any, origin: str, prefix: str = "") -> dict[str, str]:
    """Return the origin of every leaf below a value, by dotted key. An empty section has no leaves."""
    return {key: origin for key, leaf in iterate_leaves(value, prefix) if leaf != {}}


def _parse_list_index(entries: list[Any], name: str, dotted_key: str, origin: str) -> int:
    """Convert a part of a dotted key to the index of a list entry. Raises ConfigError if there is no such entry."""
    is_number = name.isdecimal() and len(name) <= MAX_LIST_INDEX_DIGITS
    if is_number and int(name) < len(entries):
        return int(name)
    if not entries:
        raise ConfigError(f"{origin}: `{dotted_key}`: the list is empty", code="config/unknown-key")
    raise ConfigError(
        f"{origin}: `{dotted_key}`: the list has entries 0 to {len(entries) - 1}; name one by its number",
        code="config/unknown-key",
    )


def iterate_leaves(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every leaf below a value as (dotted key, value).

    Entries of a list of tables are numbered from 0; any other list is one leaf, and so is an empty section.
    """
    path = f"{prefix}." if prefix else ""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from iterate_leaves(inner, f"{path}{key}")
    elif isinstance(value, list) and value and all(isinstance(entry, dict) for entry in value):
        for i, inner in enumerate(value):
            yield from iterate_leaves(inner, f"{path}{i}")
    else:
        yield prefix, value


def read_table(path: Path) -> ConfigTable:
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
            f"{path}: holds a {type(values).__name__}, not a table of settings",
            code="file/invalid-syntax",
        )
    return ConfigTable(values, str(path), _collect_origins(values, str(path)))


def resolve_file_path(name: str, kind: str, base_dir: Path | None = None) -> Path:
    """Return the path of a robot, scene or scenario file. A path is not checked: the file may be missing.

    Args:
        name: Name of a shipped file, or a path. A text with a slash or a suffix is a path.
        kind: Kind of the file, which is its folder among the shipped files: `robots`, `scenes` or `scenarios`.
        base_dir: Folder that a relative path starts from. None for the current working directory.

    Raises:
        ConfigError: There is no shipped file of that name.
    """
    if name.endswith((".toml", ".json")) or "/" in name:
        path = expand_home(name)
        if path.is_absolute() or base_dir is None:
            return path
        return base_dir / path
    if name not in list_shipped_names(kind):
        raise ConfigError(
            f"no {SINGULAR_BY_KIND[kind]} called {shorten(name)!r}{_make_unknown_name_hint(name, kind)}",
            code="config/unknown-name",
        )
    return SHIPPED_FILES_DIR / kind / f"{name}.toml"


def _make_unknown_name_hint(name: str, kind: str) -> str:
    """Return the end of the error about an unknown name: what the user may have meant, and what to do."""
    if kind == "scenarios" and name.endswith(".py"):
        return (
            f": it is Python. A controller of your own: --controller ./{shorten(name)}:CLASS, "
            "behind a scenario's name"
        )
    for other_kind in ("robots", "scenes"):
        if kind == "scenarios" and name in list_shipped_names(other_kind):
            other = SINGULAR_BY_KIND[other_kind]
            return f": it is a {other}. Give a scenario, and --set {other}={name}"
    return (
        f"; {suggest_word(name, list_shipped_names(kind))}shipped are "
        f"{', '.join(list_shipped_names(kind))}. For a file of your own give its "
        f"path, such as ./{shorten(name)}.toml"
    )


def read_table_with_base(
    name: str, kind: str, base_dir: Path | None = None, *, extending_files: tuple[Path, ...] = ()
) -> ConfigTable:
    """Read a robot or scene file, and merge it into the base file that it extends, if it has one.

    A file with `extends = "planar13"` contains only what differs from that robot.

    Args:
        name: Name of a shipped file, or a path.
        kind: Kind of the file: `robots` or `scenes`.
        base_dir: Folder that a relative path starts from. None for the current working directory.
        extending_files: Resolved paths of the files that extend this one, directly or indirectly. This file must not
            extend any of them, which would be a cycle.

    Returns:
        All values, each with the file that it comes from.

    Raises:
        ConfigError: A file is missing or not valid, or files extend each other.
    """
    path = resolve_file_path(name, kind, base_dir)
    if path.resolve() in extending_files:
        raise ConfigError(
            f"{path}: `extends` leads back to this file; remove `extends` from one file of this chain",
            code="config/conflict",
        )
    table = read_table(path)
    base_name = table.values.pop("extends", None)
    if base_name is None:
        return table
    if not isinstance(base_name, str):
        raise ConfigError(
            f"{path}: `extends` = {shorten(repr(base_name))} must be the name or the path of another file"
        )
    merged_table = read_table_with_base(
        base_name, kind, path.parent, extending_files=(*extending_files, path.resolve())
    )
    for dotted_key, value in _iterate_settings(table.values):
        merged_table.set_value(dotted_key, value, str(path))
    return merged_table


def _iterate_settings(section: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value in a section, and in the sections inside of it, as (dotted key, value); a list is one value."""
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _iterate_settings(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def expand_home(name: str) -> Path:
    """Return a path in which `~` is replaced by the home folder. Raises ConfigError if there is no such home."""
    try:
        return Path(name).expanduser()
    except RuntimeError as error:
        raise ConfigError(f"{shorten(name)}: {error}", code="file/not-found") from None


def list_shipped_names(kind: str) -> list[str]:
    """Return the names of the shipped files of a kind: `robots`, `scenes` or `scenarios`."""
    return sorted(path.stem for path in (SHIPPED_FILES_DIR / kind).glob("*.toml"))


def decode_table(table: ConfigTable, struct_type: type[StructT], section_key: str = "") -> StructT:
    """Check the values of a table, and convert them to a Struct.

    Args:
        table: Values as read, with their origins.
        struct_type: Struct class that the values must fit.
        section_key: Dotted key of the section that the table contains, for errors. Empty for a whole file.

    Raises:
        ConfigError: A value is not allowed. The error names file, field, value, unit and range.
    """
    try:
        return msgspec.convert(table.values, struct_type)
    except msgspec.ValidationError as error:
        violation = find_first_violation(table.values, struct_type)
        assert violation is not None, error
        raise ConfigError(
            _describe_violation(violation, table, section_key), code=_choose_error_code(violation)
        ) from None
    except (
        UnicodeEncodeError
    ) as error:  # JSON may escape, and a command line may hold, half of a character
        invalid_text = ascii(error.object[error.start : error.end])[:MAX_SHOWN_TEXT]
        raise ConfigError(
            f"{table.source}: a key or a text holds {invalid_text}, which is not a character; write it again"
        ) from None


def _choose_error_code(violation: TypeViolation) -> str:
    """Return the error code for a violation."""
    match violation.kind:
        case "unknown":
            return "config/unknown-key"
        case "missing":
            return "config/missing-key"
        case "wrong":
            is_number = isinstance(violation.value, int | float) and not isinstance(
                violation.value, bool
            )
            # As msgspec writes ranges.
            is_out_of_range = is_number and (">" in violation.reason or "<" in violation.reason)
            return "config/out-of-range" if is_out_of_range else "config/invalid-value"


def _describe_violation(violation: TypeViolation, table: ConfigTable, section_key: str) -> str:
    """Return the error text for a violation. The section's key is empty for a whole file."""
    if section_key:
        *parents, name = [section_key, *violation.key_path]
    else:
        *parents, name = violation.key_path or [""]
    display_key = ".".join([*parents, shorten(name)])
    match violation.kind:
        case "unknown":
            full_key = ".".join([*parents, name])
            return _describe_unknown_field(violation, table, display_key, full_key)
        case "missing":
            expected = describe_type_in_words(msgspec.inspect.type_info(violation.expected_type))
            return f"{table.find_source_file(display_key)}: field `{display_key}` is missing; add it ({expected})."
        case "wrong":
            return _describe_wrong_value(violation, table, display_key)


def _describe_unknown_field(
    violation: TypeViolation, table: ConfigTable, display_key: str, full_key: str
) -> str:
    """Return the error text for an unknown field.

    It suggests a field of the same section with a similar name, or else the same name in another section.

    Args:
        violation: Violation of kind `unknown`.
        table: All values with their origins.
        display_key: Dotted key of the field, shortened for display.
        full_key: Dotted key of the field, not shortened.
    """
    name = violation.key_path[-1]
    suggestion = find_nearest_word(name, violation.known_fields)
    if not suggestion:
        same_name_keys = [
            key
            for key in table.origin_by_key
            if key.endswith(f".{name}") and not key.startswith(full_key)
        ]
        if same_name_keys:
            suggestion = shorten(same_name_keys[0])
    hint = f"known fields: {', '.join(sorted(violation.known_fields))}."
    if suggestion:
        hint = f"did you mean `{suggestion}`?"
    origins = [
        origin
        for key, origin in table.origin_by_key.items()
        if key == display_key or key.startswith(display_key + ".")
    ]
    origin = origins[0] if origins else table.find_source_file(display_key)
    return f"{origin}: unknown field `{display_key}`; {hint}"


def _describe_wrong_value(violation: TypeViolation, table: ConfigTable, display_key: str) -> str:
    """Return the error text for a value that is not allowed.

    Args:
        violation: Violation of kind `wrong`, with the value, the expected type and the reason that msgspec gives.
        table: All values with their origins.
        display_key: Dotted key of the value. Empty for the whole file.
    """
    value = violation.value
    msgspec_reason = violation.reason
    origin = table.find_origin(display_key)
    if origin == "default":
        origin = table.find_source_file(display_key)

    # A section whose fields all have the right type can still fail the check of the section as a whole.
    section_check_failed = isinstance(value, dict) and not msgspec_reason.startswith("Expected")
    if section_check_failed:
        return (
            f"{origin}: `{display_key}`: {msgspec_reason}"
            if display_key
            else f"{origin}: {msgspec_reason}"
        )

    info = msgspec.inspect.type_info(violation.expected_type)
    unit = find_declared_unit(info)
    displayed_value = shorten(_make_safe_repr(value))
    if unit and isinstance(value, int | float):
        displayed_value += f" {unit}"
    reason = ""
    if not msgspec_reason.startswith(
        ("Expected `int", "Expected `float")
    ):  # the expected range explains more
        reason = f": {shorten(_lowercase_first_letter(msgspec_reason))}"
    expected = describe_type_in_words(info)
    return f"{origin}: `{display_key}` = {displayed_value} is not allowed{reason}; expected {expected}."


def _lowercase_first_letter(text: str) -> str:
    return text[:1].lower() + text[1:]


def _make_safe_repr(value: Any) -> str:
    """Return the repr of a value; Python refuses to print integers of more than 4300 digits."""
    try:
        return repr(value)
    except ValueError:
        return "a very large number"
