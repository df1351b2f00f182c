"""Opens every page of the built site in Chromium, checks how it looks, and makes contact sheets to look at.

    make docs
    python -m docs.site.view_site                     # every page: light at 1400 pixels, and dark at 400
    python -m docs.site.view_site --every             # both schemes at both widths
    python -m docs.site.view_site --whole             # each page down to its end, not only its top
    python -m docs.site.view_site docs/tutorials      # only pages below this folder

It writes sheets of nine tiles each to build/view and prints one line a problem. It ends with 1 if there is a problem.
"""

import argparse
import io
import json
import re
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlparse

from PIL import Image, ImageDraw

from snakesim_testing.operator.browser import BrowserTab, open_chromium

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "build" / "docs"
COPY = ROOT / "build" / "viewed"  # so that a build meanwhile changes nothing
SHEETS = ROOT / "build" / "view"
WIDTHS_PX = {1400: 1000, 400: 1800}  # width: how much of the page's height one tile shows
MAX_TILES = 6  # of one page
USUAL_VIEWS = ((1400, "light"), (400, "dark"))
EVERY_VIEW = ((1400, "light"), (1400, "dark"), (400, "light"), (400, "dark"))
TILES_PER_SHEET = 9
COLUMNS = {1400: 3, 400: 9}
TILE_PX = {1400: 700, 400: 280}  # width of a page on a sheet
MIN_CONTRAST = 3.0  # WCAG for large text; the theme's small gray text is near 4
LOAD_LIMIT_S = 60.0

# What the browser finds wrong on the page that it shows. Code and tables may scroll inside a box of their own.
CHECK = r"""
(() => {
  const found = [];
  const width = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > width + 1)
    found.push(`the page is ${document.documentElement.scrollWidth} pixels wide`);
  const article = document.querySelector('article') || document.body;
  const scrolls = e => { for (let p = e; p && p !== document.body; p = p.parentElement) {
    const x = getComputedStyle(p).overflowX; if (x !== 'visible') return true; } return false; };
  for (const e of article.querySelectorAll('table, pre, img, p, li, h1, h2, h3, code')) {
    const r = e.getBoundingClientRect();
    if (r.width && r.right > width + 1 && !scrolls(e))
      found.push(`<${e.tagName.toLowerCase()}> ends at ${Math.round(r.right)}: ${e.innerText.slice(0, 60)}`);
  }
  for (const e of article.querySelectorAll('img')) {
    if (e.complete && e.naturalWidth === 0) found.push(`picture not loaded: ${e.getAttribute('src')}`);
    if (!(e.getAttribute('alt') || '').trim()) found.push(`picture without a text: ${e.getAttribute('src')}`);
  }
  for (const e of article.querySelectorAll('th')) if (!e.innerText.trim()) found.push('empty header cell');
  const channels = c => (c.match(/[\d.]+/g) || []).map(Number);
  const luminance = c => { const [r, g, b] = c.slice(0, 3).map(v => { v /= 255;
    return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; }); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const backdrop = e => { for (let p = e; p; p = p.parentElement) {
    const c = channels(getComputedStyle(p).backgroundColor); if (c.length === 3 || c[3] > 0.9) return c; }
    return [255, 255, 255]; };
  const seen = new Set();
  for (const e of article.querySelectorAll('p, li, td, th, code, code span, h1, h2, h3, a, summary')) {
    if (![...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()) || e.closest('.headerlink')) continue;
    const style = getComputedStyle(e);
    let front = channels(style.color), back = backdrop(e);
    if (front.length === 4) front = front.slice(0, 3).map((v, i) => v * front[3] + back[i] * (1 - front[3]));
    const [a, b] = [luminance(front), luminance(back)];
    const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const key = style.color + back;
    if (contrast < MIN_CONTRAST && !seen.has(key)) {
      seen.add(key);
      found.push(`contrast ${contrast.toFixed(1)}: ${e.innerText.slice(0, 40)}`);
    }
  }
  return JSON.stringify(found);
})()
""".replace("MIN_CONTRAST", str(MIN_CONTRAST))


def main() -> int:
    """Check the pages and make the sheets."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "under", nargs="*", default=[""], help="only pages whose path begins like this"
    )
    parser.add_argument("--every", action="store_true", help="both color schemes at both widths")
    parser.add_argument(
        "--whole", action="store_true", help="continue a long page in further tiles of its sheet"
    )
    arguments = parser.parse_args()
    shutil.rmtree(COPY, ignore_errors=True)
    shutil.copytree(SITE, COPY)
    pages = [page for page in list_pages() if str(page).startswith(tuple(arguments.under))]
    if not pages:
        sys.exit("view: build/docs has no such page; run `make docs`")
    SHEETS.mkdir(parents=True, exist_ok=True)
    problems = 0
    for problem in check(pages, arguments):
        print(problem, flush=True)
        problems += 1
    print(f"{len(pages)} pages, {problems} problems; sheets in {SHEETS.relative_to(ROOT)}")
    return 1 if problems else 0


def check(pages: list[Path], arguments: argparse.Namespace) -> Iterator[str]:
    """Yield every problem of the pages: broken links first, then what the browser finds."""
    for page in pages:
        yield from (f"{page}: {problem}" for problem in find_broken_links(page))
    views = EVERY_VIEW if arguments.every else USUAL_VIEWS
    sheets = {each: Sheets(*each) for each in views}
    with open_chromium(with_webgl=False) as browser:
        tab = browser.open_page("about:blank")
        tab.send("Network.enable")
        tab.send("Network.setBlockedURLs", urls=["*search_index.js*"])  # large, and not needed here
        for page in pages:
            yield from view(tab, page, sheets, max_tiles=MAX_TILES if arguments.whole else 1)
    for each in sheets.values():
        each.save()


def list_pages() -> list[Path]:
    """Return the pages of the site, relative to it; the links of 404.html begin at the address of a published site."""
    return sorted(
        page.relative_to(COPY) for page in COPY.rglob("*.html") if page.name != "404.html"
    )


def find_broken_links(page: Path) -> Iterator[str]:
    """Yield every link of a page to a file or an anchor that the site does not have."""
    text = (COPY / page).read_text(encoding="utf-8")
    for link in dict.fromkeys(
        re.findall(r"""<(?:a|img|link|script)\b[^>]*?\b(?:href|src)=["']?([^"'\s>]+)""", text)
    ):
        address = urlparse(link)
        if address.scheme or address.netloc:
            continue
        target = (
            (COPY / page.parent / unquote(address.path)).resolve() if address.path else COPY / page
        )
        if not target.exists():
            yield f"broken link: {link}"
        elif address.fragment and target.suffix == ".html":
            anchor = re.escape(unquote(address.fragment))
            if not re.search(rf"""\bid=["']?{anchor}["'\s>]""", target.read_text(encoding="utf-8")):
                yield f"broken anchor: {link}"


def view(
    tab: BrowserTab, page: Path, sheets: dict[tuple[int, str], "Sheets"], max_tiles: int
) -> Iterator[str]:
    """Yield the problems of a page in every view, and put its pictures on the sheets."""
    open_page(tab, page)
    for (width, scheme), sheet in sheets.items():
        set_view(tab, width, scheme)
        for problem in json.loads(tab.evaluate(CHECK) or "[]"):
            yield f"{page} ({width}, {scheme}): {problem}"
        tiles = 1
        if max_tiles > 1:
            page_height = int(tab.evaluate("document.documentElement.scrollHeight"))
            tiles = min(-(-page_height // WIDTHS_PX[width]), max_tiles)
            set_view(tab, width, scheme, tiles)
        sheet.add(page, tab.capture_screenshot(), tiles)
    yield from (f"{page}: {error}" for error in tab.errors if "search_index" not in error)
    tab.errors.clear()


def set_view(tab: BrowserTab, width: int, scheme: str, tiles: int = 1) -> None:
    """Set the width and the height of the window, and the color scheme of the page.

    Args:
        tab: The page.
        width: Width of the window, in points.
        scheme: Color scheme, `light` or `dark`.
        tiles: Height of the window, in tiles of a contact sheet.
    """
    tab.set_window_size(
        width, tiles * WIDTHS_PX[width], scale=TILE_PX[width] / width, mobile=width < 600
    )
    attribute = json.dumps("slate" if scheme == "dark" else "default")
    # The button of the theme does the same.
    tab.evaluate(f"document.body.setAttribute('data-md-color-scheme', {attribute})")
    time.sleep(0.2)  # until the browser has laid out the page


def open_page(tab: BrowserTab, page: Path) -> None:
    """Open a page, and load also the pictures that are visible only after scrolling."""
    tab.send("Page.navigate", url=f"file://{COPY / page}")
    deadline = time.monotonic() + LOAD_LIMIT_S
    name = json.dumps(page.name)
    while (
        tab.evaluate(f"document.readyState === 'complete' && location.pathname.endsWith({name})")
        is not True
    ):
        if time.monotonic() > deadline:
            raise TimeoutError(f"{page} does not load")
        time.sleep(0.02)
    tab.evaluate(
        "document.head.insertAdjacentHTML('beforeend', '<style>* { transition: none !important }</style>')"
    )
    time.sleep(0.15)  # the theme wraps tables and colors code


class Sheets:
    """The contact sheets of one view: tiles side by side, each under its page's path."""

    def __init__(self, width: int, scheme: str) -> None:
        self._width = width
        self._name = f"{width}-{scheme}"
        self._tile_width = TILE_PX[width]
        self._tile_height = WIDTHS_PX[width] * self._tile_width // width
        self._tiles: list[tuple[str, Image.Image]] = []
        self._saved = 0

    def add(self, page: Path, picture: bytes, tiles: int) -> None:
        """Add a picture of a page as some tiles, from its top to its end."""
        with Image.open(io.BytesIO(picture)) as opened:
            whole = opened.convert("RGB")
        for number in range(tiles):
            top = number * self._tile_height
            title = str(page) if number == 0 else f"{page.stem}, part {number + 1}"
            self._tiles.append(
                (title, whole.crop((0, top, self._tile_width, top + self._tile_height)))
            )
            if len(self._tiles) == TILES_PER_SHEET:
                self.save()

    def save(self) -> None:
        """Write the tiles added since the last sheet, if there are any."""
        if not self._tiles:
            return
        columns = COLUMNS[self._width]
        rows = TILES_PER_SHEET // columns
        sheet = Image.new(
            "RGB", (columns * (self._tile_width + 8), rows * (self._tile_height + 24)), "gray"
        )
        draw = ImageDraw.Draw(sheet)
        for number, (title, tile) in enumerate(self._tiles):
            left = number % columns * (self._tile_width + 8)
            top = number // columns * (self._tile_height + 24)
            draw.text((left + 4, top + 4), title, fill="white", font_size=14)
            sheet.paste(tile, (left, top + 24))
        sheet.save(SHEETS / f"{self._name}-{self._saved:03}.png")
        self._tiles.clear()
        self._saved += 1


if __name__ == "__main__":
    sys.exit(main())
