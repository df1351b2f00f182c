"""Plain values as TOML text, in the order of the table: for robot files that a person will read and edit."""

import json
from typing import Any


def toml_of(values: dict[str, Any], notes: list[str]) -> str:
    """A TOML file. notes: comments at its top. Values that are None are left out, as TOML has none."""
    lines = [f"# {note}".rstrip() for note in notes]
    lines += [""] * bool(notes)
    return "\n".join([*lines, *_section(values, "")]) + "\n"


def _section(values: dict[str, Any], name: str) -> list[str]:
    lines, below = list[str](), list[str]()
    for key, value in values.items():
        dotted = f"{name}.{key}" if name else key
        if isinstance(value, dict):
            below += ["", f"[{dotted}]", *_section(value, dotted)]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                below += ["", f"[[{dotted}]]", *_section(entry, dotted)]
        elif value is not None:
            lines.append(f"{key} = {_value(value)}")
    return lines + below


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    # JSON's texts, numbers, true and false are TOML's, but for DEL, which TOML wants escaped, and infinities.
    return json.dumps(value, ensure_ascii=False, allow_nan=False).replace("\x7f", "\\u007f")
