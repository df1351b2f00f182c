"""Tests the line breaks and the `|` of code in table cells of the documentation."""

from docs.site.code_breaks import on_page_content


def test_long_code_in_a_cell_may_break_after_a_separator() -> None:
    html = "<td><code>tests/unit/hal/test_lease.py</code></td>"
    expected = "<td><code>tests/<wbr>unit/<wbr>hal/<wbr>test_<wbr>lease.<wbr>py</code></td>"
    assert on_page_content(html) == expected


def test_code_in_a_cell_shows_no_backslash_before_a_bar() -> None:
    assert on_page_content("<td><code>zsh\\|bash</code></td>") == "<td><code>zsh|bash</code></td>"


def test_code_outside_of_a_table_is_unchanged() -> None:
    html = "<p><code>tests/unit/hal/test_lease.py\\|</code></p>"
    assert on_page_content(html) == html
