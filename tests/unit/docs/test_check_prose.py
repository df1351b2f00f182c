"""Tests that the checker of the documentation's English finds wrong sentences, and ignores code."""

import importlib.util
import itertools
import sys
from pathlib import Path
from types import ModuleType

import pytest

CHECKER = Path(__file__).parents[3] / "docs" / "style" / "check_prose.py"


@pytest.fixture(scope="module")
def checker() -> ModuleType:
    specification = importlib.util.spec_from_file_location("check_prose", CHECKER)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["check_prose"] = module
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("line", "is_rejected"),
    [
        ("The sensor tells its range.", True),
        ("Nobody commands the robot.", True),
        ("The bus gets no set-points.", True),
        ("The sensor publishes its range.", False),
        ("Add a tell-tale.", False),
    ],
)
def test_reject_list_line_finds_words(checker: ModuleType, line: str, is_rejected: bool) -> None:
    problems = list(checker.find_rejected(line, checker.read_reject_list(), in_docs=True))
    assert bool(problems) == is_rejected


def test_remove_code_page_keeps_line_numbers(checker: ModuleType) -> None:
    lines = ["Use `nobody` here.", "```sh", "nobody", "```", "See [this](nobody.md)."]
    assert checker.remove_code(lines) == ["Use `code` here.", "", "", "", "See [this]."]


def test_table_with_empty_header_cell_is_found(checker: ModuleType) -> None:
    table = ["| name | |", "|---|---|", "| a | b |", "", "| name | value |", "|---|---|"]
    assert list(checker.find_tables_without_header(table)) == [1]


def test_long_sentence_is_found_with_its_line(checker: ModuleType) -> None:
    word_count = checker.MAX_SENTENCE_WORDS + 1
    long_sentence = " ".join(["word"] * word_count) + "."
    page = ["Short one.", "", long_sentence]
    assert list(checker.find_long_sentences(page)) == [(3, word_count)]


def test_heading_without_text_is_found(checker: ModuleType) -> None:
    page = [
        "# Page",
        "",
        "## Old name",
        "",
        "## New name",
        "",
        "Text.",
        "",
        "### Part",
        "",
        "## End",
    ]
    assert list(checker.find_empty_sections(page)) == [3, 9, 11]
    assert not list(checker.find_empty_sections(["# Page", "## Part", "```sh", "# comment", "```"]))


def test_repeated_sentence_is_found_with_its_line(checker: ModuleType) -> None:
    sentence = "The host checks the lease once in each period."
    repeated_sentences = list(
        checker.find_repeated_sentences([sentence, "", f"Again. {sentence}", "", "Again."])
    )
    assert repeated_sentences == [(3, sentence)]


def test_headings_of_all_pages_follow_an_empty_line() -> None:
    """A heading directly after a table would be a row of it on the site."""
    root = CHECKER.parents[2]
    pages = [
        page
        for folder in ("docs", "schemas", "benchmarks", "deploy")
        for page in (root / folder).rglob("*.md")
    ]
    headings_after_tables = [
        f"{page.relative_to(root)}:{number}"
        for page in [*pages, *root.glob("*.md")]
        for number, (line, following) in enumerate(
            itertools.pairwise(page.read_text(encoding="utf-8").splitlines()), 2
        )
        if line.startswith("|") and following.startswith("#")
    ]
    assert headings_after_tables == []
