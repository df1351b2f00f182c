"""Tests that the diagrams of the documentation are those of their program, and that pages use all pictures."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from docs.site.diagrams import FOLDER, make_diagrams

DOCS = Path(__file__).parents[3] / "docs"
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)]*pictures/[^)]+)\)")


def test_diagrams_are_drawn_by_the_present_program() -> None:
    """`python -m docs.site.diagrams` writes the diagrams."""
    outdated_diagrams = [
        path.name
        for path, text in make_diagrams().items()
        if path.read_text(encoding="utf-8") != text
    ]
    assert outdated_diagrams == []


def test_diagrams_are_valid_xml() -> None:
    for path in FOLDER.glob("*.svg"):
        ElementTree.parse(path)


def test_pictures_are_used_and_have_alternative_texts() -> None:
    pages = [*DOCS.rglob("*.md"), DOCS.parent / "README.md"]
    # Page, alternative text and target of each picture.
    pictures = [
        (page, *match)
        for page in pages
        for match in PICTURE.findall(page.read_text(encoding="utf-8"))
    ]
    pictures_without_text = [
        f"{page.name}: {target}" for page, text, target in pictures if len(text.split()) < 3
    ]
    assert pictures_without_text == []
    used_files = {Path(target).name for _, _, target in pictures}
    assert {path.name for path in FOLDER.iterdir()} - used_files == set()


def test_tutorials_and_hardware_pages_have_a_picture() -> None:
    pages = [page for folder in ("tutorials", "hardware") for page in (DOCS / folder).glob("*.md")]
    pages_without_picture = [
        page.name for page in pages if not PICTURE.search(page.read_text(encoding="utf-8"))
    ]
    assert pages_without_picture == []
