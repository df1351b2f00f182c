"""The pages of the Python API: in step with the code, complete, and with examples that run."""

import re
from pathlib import Path

import pytest

from docs.site.api_contents import INTERNAL, PAGES, Page
from docs.site.api_pages import FOLDER, find, find_undocumented, format_text, make_pages
from docs.site.python_source import parse_docstring, read_class
from snakesim_hal.backend import Backend


def test_the_pages_are_those_of_the_code() -> None:
    """`make schemas` writes them."""
    pages = make_pages()
    assert {path for path in FOLDER.iterdir() if path.suffix == ".md"} == set(pages)
    assert [
        path.name for path, text in pages.items() if path.read_text(encoding="utf-8") != text
    ] == []


def test_everything_public_is_documented() -> None:
    assert find_undocumented() == []


def test_internal_names_exist() -> None:
    for module, names in INTERNAL.items():
        for name in names:
            assert find(module, name) is not None


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.example], ids=lambda page: page.file
)
def test_the_example_is_valid_python(page: Page) -> None:
    compile(page.example, page.file, "exec")
    # Tests of runs are elsewhere.
    if "snakesim.run" not in page.example and "gymnasium" not in page.example:
        exec(page.example, {"__name__": "example"})


def test_a_docstring_is_split_by_its_sections() -> None:
    docstring = parse_docstring(
        """Do it.

        Args:
            speed_m_s: How fast; at
                most 1.
            *names: Which.

        Returns:
            The number.

        Raises:
            ValueError: It is wrong.
        """
    )
    assert docstring.text == "Do it."
    assert docstring.arguments == {"speed_m_s": "How fast; at most 1.", "names": "Which."}
    assert docstring.returns == "The number."
    assert docstring.raises == {"ValueError": "It is wrong."}


def test_indented_code_becomes_a_block() -> None:
    assert (
        format_text("Run it:\n\n    x = 1\n\nThen stop.")
        == "Run it:\n\n```python\nx = 1\n```\n\nThen stop."
    )
    assert (
        format_text("Threads\n    One thread makes all calls.")
        == "**Threads.** One thread makes all calls."
    )


def test_private_members_are_left_out() -> None:
    source = read_class(Backend)
    assert [method.name for method in source.methods if method.name.startswith("_")] == []
    assert "sample" in {method.name for method in source.methods}


def test_no_page_shows_a_private_name() -> None:
    for text in make_pages().values():
        assert not re.findall(r"^#+ .*\._[a-z]", text, re.MULTILINE)


def test_pages_are_in_the_menu() -> None:
    menu = (Path(__file__).parents[3] / "docs" / "site" / "mkdocs.yml").read_text(encoding="utf-8")
    assert [page.file for page in PAGES if f"docs/reference/api/{page.file}\n" not in menu] == []
