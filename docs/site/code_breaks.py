"""A hook of mkdocs: lets long code in table cells break after a separator, such as `tests/unit/` + `test_lease.py`.

Without it a browser either breaks names between any two letters, or makes the column as wide as the longest name. It
also shows a `|` in such code without the backslash that Markdown needs in a table.
"""

import re
from typing import Any

MIN_LETTERS = 16  # shorter code stays on one line
CELL = re.compile(r"<t[dh]\b.*?</t[dh]>", re.DOTALL)
CODE = re.compile(r"(<code>)([^<]*)(</code>)")
SEPARATOR = re.compile(r"(::|[/_.=,:|])(?=[\w\[{\"'-])")


def on_page_content(html: str, **_: Any) -> str:
    """Return a page's HTML with places to break in the code of its tables."""
    return CELL.sub(_allow_breaks_in_cell, html)


def _allow_breaks_in_cell(cell: re.Match[str]) -> str:
    return CODE.sub(_allow_breaks_in_code, cell[0])


def _allow_breaks_in_code(code: re.Match[str]) -> str:
    opening, text, closing = code.groups()
    text = text.replace("\\|", "|")
    if len(text) < MIN_LETTERS:
        return opening + text + closing
    return opening + SEPARATOR.sub(r"\1<wbr>", text) + closing
