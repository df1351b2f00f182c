"""Writes plain values as TOML text, in the order of the table, for robot files that a person will read and edit."""

import json
from typing import Any


def format_toml(values: dict[str, Any], notes: list[str]) -> str:
    """Return the text of a TOML file.

    Args:
        values: The top table. Values that are None are left out, as TOML has none.
        notes: Comments at the top.
    """
    lines = [f"# {note}".rstrip() for note in notes]
    if notes:
        lines.append("")
    return "\n".join([*lines, *_format_section(values, "")]) + "\n"


def _format_section(values: dict[str, Any], name: str) -> list[str]:
    """Return the lines of a table: first its own values, then the tables below it."""
    lines: list[str] = []
    below: list[str] = []
    for key, value in values.items():
        dotted = f"{name}.{key}" if name else key
        if isinstance(value, dict):
            below += ["", f"[{dotted}]", *_format_section(value, dotted)]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                below += ["", f"[[{dotted}]]", *_format_section(entry, dotted)]
        elif value is not None:
            lines.append(f"{key} = {_format_value(value)}")
    return lines + below


def _format_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    # JSON's texts, numbers, true and false are TOML's, but for DEL, which TOML wants escaped, and infinities.
    return json.dumps(value, ensure_ascii=False, allow_nan=False).replace("\x7f", "\\u007f")
