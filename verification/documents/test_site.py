"""The documentation as a site: every page is on it, it needs no network, and its search works from a folder."""

import re
import subprocess
import sys

import pytest

from snakesim_testing.operator.browser import BROWSER_MISSING, CHROMIUM, open_chromium
from snakesim_testing.runs.documents import REPOSITORY

SITE = REPOSITORY / "build" / "docs"


def test_the_menu_has_every_page() -> None:
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
def test_the_site_is_searched_from_a_folder_without_a_network() -> None:
    """`make docs` fails at a link into nowhere."""
    subprocess.run([sys.executable, "docs/site/build.py"], cwd=REPOSITORY, check=True)
    loaded = re.compile(r"""<(?:script|link|img|iframe)[^>]*(?:src|href)=["']?(?:https?:)?//""")
    assert not [page for page in SITE.rglob("*.html") if loaded.search(page.read_text())]
    # A block taken for a text.
    assert not [page for page in SITE.rglob("*.html") if "<code>``" in page.read_text()]
    with open_chromium() as browser:
        tab = browser.open_page(f"file://{SITE}/docs/concepts/safety.html")
        tab.wait_for("Safety")
        tab.wait_until_loaded()
        tab.evaluate("document.querySelector('input[name=query]').focus()")
        tab.send("Input.insertText", text="leas")
        tab.press_key("e", 69, text="e")  # the page looks at what is there when a key comes up
        tab.wait_for("matching documents")
        assert not tab.errors
