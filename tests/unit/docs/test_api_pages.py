"""Tests that the pages of the Python API agree with the code, are complete, and have examples that run."""

import re
from pathlib import Path

import pytest

from docs.site.api_contents import INTERNAL, PAGES, Page
from docs.site.api_pages import FOLDER, find, find_undocumented, format_text, make_pages
from docs.site.python_source import parse_docstring, read_class
from snakesim_hal.backend import Backend


def test_api_pages_are_generated_from_the_present_code() -> None:
    """`make schemas` writes the pages."""
    pages = make_pages()
    assert {path for path in FOLDER.iterdir() if path.suffix == ".md"} == set(pages)
    outdated_pages = [
        path.name for path, text in pages.items() if path.read_text(encoding="utf-8") != text
    ]
    assert outdated_pages == []


def test_api_pages_document_everything_public() -> None:
    assert find_undocumented() == []


def test_api_pages_list_only_internal_names_that_exist() -> None:
    for module, names in INTERNAL.items():
        for name in names:
            assert find(module, name) is not None


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.example], ids=lambda page: page.file
)
def test_api_page_example_is_valid_python(page: Page) -> None:
    compile(page.example, page.file, "exec")
    # Tests of runs are elsewhere.
    if "snakesim.run" not in page.example and "gymnasium" not in page.example:
        exec(page.example, {"__name__": "example"})


def test_docstring_is_split_into_its_sections() -> None:
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


def test_indented_text_of_a_docstring_becomes_a_code_block() -> None:
    assert (
        format_text("Run it:\n\n    x = 1\n\nThen stop.")
        == "Run it:\n\n```python\nx = 1\n```\n\nThen stop."
    )
    assert (
        format_text("Threads\n    One thread makes all calls.")
        == "**Threads.** One thread makes all calls."
    )


def test_api_source_of_class_leaves_out_private_members() -> None:
    method_names = [method.name for method in read_class(Backend).methods]
    assert [name for name in method_names if name.startswith("_")] == []
    assert "sample" in method_names


def test_api_pages_have_no_headings_of_private_names() -> None:
    for text in make_pages().values():
        assert not re.findall(r"^#+ .*\._[a-z]", text, re.MULTILINE)


def test_api_pages_are_in_the_menu() -> None:
    menu = (Path(__file__).parents[3] / "docs" / "site" / "mkdocs.yml").read_text(encoding="utf-8")
    missing_pages = [page.file for page in PAGES if f"docs/reference/api/{page.file}\n" not in menu]
    assert missing_pages == []
