"""The diagrams of the documentation: as their program draws them, and used."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from docs.site.diagrams import FOLDER, make_diagrams

DOCS = Path(__file__).parents[3] / "docs"
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)]*pictures/[^)]+)\)")


def test_the_diagrams_are_those_of_the_program() -> None:
    """`python -m docs.site.diagrams` writes them."""
    assert [
        path.name
        for path, text in make_diagrams().items()
        if path.read_text(encoding="utf-8") != text
    ] == []


def test_every_drawing_is_valid() -> None:
    for path in FOLDER.glob("*.svg"):
        ElementTree.parse(path)


def test_every_picture_is_used_and_has_a_text() -> None:
    pages = [*DOCS.rglob("*.md"), DOCS.parent / "README.md"]
    found = [
        (page, *match)
        for page in pages
        for match in PICTURE.findall(page.read_text(encoding="utf-8"))
    ]
    assert [f"{page.name}: {target}" for page, text, target in found if len(text.split()) < 3] == []
    used = {Path(target).name for _, _, target in found}
    assert {path.name for path in FOLDER.iterdir()} - used == set()


def test_tutorials_and_hardware_pages_have_a_picture() -> None:
    pages = [page for folder in ("tutorials", "hardware") for page in (DOCS / folder).glob("*.md")]
    assert [
        page.name for page in pages if not PICTURE.search(page.read_text(encoding="utf-8"))
    ] == []
