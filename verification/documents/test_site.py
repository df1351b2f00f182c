"""Tests of the documentation site: it has every page, needs no network, and its search works from a folder."""

import re
import subprocess
import sys

import pytest

from snakesim_testing.operator.browser import BROWSER_MISSING, CHROMIUM, open_chromium
from snakesim_testing.runs.documents import REPOSITORY

SITE = REPOSITORY / "build" / "docs"


def test_menu_contains_every_page() -> None:
    menu = (REPOSITORY / "docs" / "site" / "mkdocs.yml").read_text()
    pages = [
        page.relative_to(REPOSITORY)
        for folder in ("docs", "schemas")
        for page in (REPOSITORY / folder).rglob("*.md")
    ]
    assert not [page for page in pages if f"{page}\n" not in menu]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(CHROMIUM is None, reason=BROWSER_MISSING)
def test_site_search_works_from_folder_without_network() -> None:
    subprocess.run([sys.executable, "docs/site/build.py"], cwd=REPOSITORY, check=True)
    loads_from_network = re.compile(
        r"""<(?:script|link|img|iframe)[^>]*(?:src|href)=["']?(?:https?:)?//"""
    )
    pages = {page: page.read_text() for page in SITE.rglob("*.html")}
    assert not [page for page, html in pages.items() if loads_from_network.search(html)]
    # A code block that was rendered as text contains this element.
    assert not [page for page, html in pages.items() if "<code>``" in html]
    with open_chromium() as browser:
        tab = browser.open_page(f"file://{SITE}/docs/concepts/safety.html")
        tab.wait_for("Safety")
        tab.wait_until_loaded()
        tab.evaluate("document.querySelector('input[name=query]').focus()")
        tab.send("Input.insertText", text="leas")
        tab.press_key("e", 69, text="e")  # the page starts a search at the release of a key
        tab.wait_for("matching documents")
        assert not tab.errors
