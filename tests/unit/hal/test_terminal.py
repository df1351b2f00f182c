"""Printed text contains no characters that control the terminal, and JSON remains valid."""

import ast
import json
import sys
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import escape_invisible, overwrite_line, print_line, report_error

REPOSITORY = Path(__file__).parents[3]
# Categories of control, format (also bidirectional overrides), surrogate and separator characters.
CONTROL_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def test_terminal_control_characters_are_printed_as_escapes() -> None:
    for code in range(sys.maxunicode + 1):
        if unicodedata.category(chr(code)) in CONTROL_CATEGORIES:
            assert escape_invisible(f"a{chr(code)}b").isascii(), hex(code)
    assert (
        escape_invisible("\x1b[2J\x9b31m\r\n\u202eoff")
        == "\\u001b[2J\\u009b31m\\u000d\\u000a\\u202eoff"
    )
    assert escape_invisible("\U000e0041") == "\\udb40\\udc41"
    assert escape_invisible("3 N·m, ü, 関節, ⟂") == "3 N·m, ü, 関節, ⟂"
    assert escape_invisible("a\nb\tc", keep="\n") == "a\nb\\u0009c"


@given(st.text())
def test_terminal_escaped_json_is_still_valid_json(text: str) -> None:
    value = {text: [text]}
    printed = escape_invisible(json.dumps(value, ensure_ascii=False))
    assert json.loads(printed) == value
    assert "\n" not in printed


def test_terminal_output_has_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    print_line("\x1b]0;title\x07")
    report_error(ConfigError("a.toml: \x9b2J\n  next: trust me", "second line"), "snakesim")
    assert overwrite_line("tick 10 \x1b[1A and much more", 24, 3) == 24
    out, err = capsys.readouterr()
    assert out == "\\u001b]0;title\\u0007\n\rtick 10 \\u001b[1A and mu"
    assert (
        err
        == "snakesim: a.toml: \\u009b2J\\u000a  next: trust me [config/invalid-value]\nsecond line\n"
    )


def test_terminal_streams_are_never_written_directly() -> None:
    """Find writes to the streams. `make check` refuses `print`."""
    for package in REPOSITORY.glob("snakesim*"):
        for path in package.rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            # Parsing all files takes seconds.
            if ".stdout.write" not in text and ".stderr.write" not in text:
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Attribute) and node.attr in ("write", "writelines"):
                    assert ast.unparse(node.value) not in ("sys.stdout", "sys.stderr"), path
