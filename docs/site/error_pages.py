"""The page docs/reference/errors.md, from the registry of codes; `python -m docs.site.error_pages` writes it."""

from collections.abc import Mapping
from pathlib import Path

from snakesim_hal.base.error_codes import ERROR_CODES, ErrorCode
from snakesim_hal.base.fault_codes import FAULT_CODES, REFUSAL_CODES

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "errors.md"
HEAD = """# Errors and faults

Every error ends its first line with a code, such as `[config/unknown-key]`. Search this page for the code. Codes are
stable: scripts may compare them, as `error.code` in Python and in the output of `--json`. The text of a message may
change.

Made by `make schemas`; edit `snakesim_hal/base/error_codes.py` and `fault_codes.py` instead.
"""
FAULTS = """
## Faults

`Status.faults` names each fault by one of these words in `what`, with its cause as a text. The row says what to do
before you clear the fault.
"""
REFUSALS = """
## Refusals

The host answers a refused request with one of these words in `Answer.refusal`, and counts rejected commands by them
in `Status.commands_rejected`.
"""


def make_page() -> str:
    """Return the page as it should be."""
    parts = [HEAD]
    for area in dict.fromkeys(code.partition("/")[0] for code in ERROR_CODES):
        rows = {code: entry for code, entry in ERROR_CODES.items() if code.startswith(f"{area}/")}
        parts += [f"\n## {area}\n\n", _make_table("code", rows)]
    parts += [FAULTS, "\n", _make_table("what", FAULT_CODES)]
    parts += [REFUSALS, "\n", _make_table("word", REFUSAL_CODES)]
    return "".join(parts)


def _make_table(first_column: str, rows: Mapping[str, ErrorCode]) -> str:
    lines = [f"| {first_column} | meaning | cause | what to do |", "|---|---|---|---|"]
    for code, entry in rows.items():
        steps = f" [Step by step](../{entry.page})" if entry.page else ""
        lines.append(f"| `{code}` | {entry.title} | {entry.cause} | {entry.remedy}{steps} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")
