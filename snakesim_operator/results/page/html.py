"""Pages from templates. Whatever comes from outside is escaped here: in text by Jinja, in figures by `chart`."""

from collections.abc import Sequence
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import jinja2
import msgspec
from markupsafe import Markup

from snakesim_hal.base.terminal import escape_invisible
from snakesim_operator.results.page.charts import LIBRARY, Figure
from snakesim_operator.results.page.palette import themes

HERE = Path(__file__).parent
KEPT = "\n\u202f\u00a0"  # line breaks of a configuration, and the blanks in large numbers
MINUS = str.maketrans({"-": "−"})


def render(
    template: Path,
    colored_joints: int,
    *,
    styles: Sequence[Path] = (),
    scripts: Sequence[Path] = (),
    charts: bool = True,
    **values: Any,
) -> str:
    """Return an HTML page that needs no other file: styles, scripts and the plotting library are embedded.

    Args:
        template: The Jinja template of the page.
        colored_joints: How many joints need a color of their own.
        styles: Style sheets besides those that all pages share.
        scripts: Scripts besides those of the charts.
        charts: Whether the page has charts, which need the plotting library.
        values: Variables of the template.
    """
    style = themes(colored_joints) + _text(HERE / "page.css", *styles)
    library = ""
    chart_scripts: list[Path] = []
    if charts:
        library = _text(LIBRARY)
        chart_scripts = [HERE / "charts.js"]
    page = _pages(template.parent).get_template(template.name)
    return page.render(
        style=Markup(style),
        library=Markup(library),
        script=Markup(_text(*chart_scripts, *scripts)),
        **values,
    )


def chart(figure: Figure) -> Markup:
    """Return the markup of a figure, with its data beside it."""
    label = Markup.escape(escape_invisible(figure["label"]))
    return Markup(
        f'<figure class="chart" role="group" aria-label="{label}" style="min-height:{figure["layout"]["height"]}px">'
        f'<div class="plot"></div><div class="cursor"></div>{data(figure)}</figure>'
    )


def data(value: Any) -> Markup:
    """Return JSON for a script of the page, in which no text can be taken for markup."""
    encoded = msgspec.json.encode(_harmless(value)).decode().replace("<", "\\u003c")
    return Markup(f'<script type="application/json">{encoded}</script>')


def shown(value: float, digits: int = 4) -> str:
    """Return a number for people, with a typographic minus sign, and none before a zero.

    Args:
        value: The number.
        digits: How many significant digits.
    """
    value += 0.0
    if value != 0 and (abs(value) >= 10**digits or abs(value) < 1e-4):
        whole = f"{value:,.0f}".replace(",", "\u202f")
        return (whole if abs(value) >= 1 else f"{value:.2e}").translate(MINUS)
    return f"{value:.{digits}g}".translate(MINUS)


@cache
def _pages(folder: Path) -> jinja2.Environment:
    """Return the templates of a folder, and those that all pages share."""
    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, HERE]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_visible,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.filters.update(chart=chart, data=data, shown=shown)
    return pages


def _visible(value: Any) -> Any:
    """Return a value whose control characters, which would hide or reverse the text around them, are visible."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return escape_invisible(value, KEPT)
    return value


def _harmless(value: Any) -> Any:
    """Escape every text in a value."""
    if isinstance(value, str):
        return escape(escape_invisible(value), quote=False)
    if isinstance(value, dict):
        return {key: _harmless(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_harmless(item) for item in value]
    return value


def _text(*paths: Path) -> str:
    return "".join(path.read_text(encoding="utf-8") for path in paths)
