"""Pages from templates. Whatever comes from outside is escaped here: in text by Jinja, in figures by `chart`."""

from collections.abc import Sequence
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import jinja2
import msgspec
from markupsafe import Markup

from snakesim_hal.base.terminal import printable
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
    """A whole page that needs no other file. colored_joints: how many need a color; charts: whether it has any."""
    return (
        _pages(template.parent)
        .get_template(template.name)
        .render(
            style=Markup(themes(colored_joints) + _text(HERE / "page.css", *styles)),
            library=Markup(_text(LIBRARY) if charts else ""),
            script=Markup(_text(*([HERE / "charts.js"] if charts else []), *scripts)),
            **values,
        )
    )


def chart(figure: Figure) -> Markup:
    """A figure, and its data beside it."""
    label = Markup.escape(printable(figure["label"]))
    return Markup(
        f'<figure class="chart" role="group" aria-label="{label}" style="min-height:{figure["layout"]["height"]}px">'
        f'<div class="plot"></div><div class="cursor"></div>{data(figure)}</figure>'
    )


def data(value: Any) -> Markup:
    """JSON for a script of the page, with no text in it that the page or a figure would take for markup."""
    encoded = msgspec.json.encode(_harmless(value)).decode().replace("<", "\\u003c")
    return Markup(f'<script type="application/json">{encoded}</script>')


def shown(value: float, digits: int = 4) -> str:
    """A number for people: so many significant digits, a real minus sign, and none before a zero."""
    value += 0.0
    if value != 0 and (abs(value) >= 10**digits or abs(value) < 1e-4):
        whole = f"{value:,.0f}".replace(",", "\u202f")
        return (whole if abs(value) >= 1 else f"{value:.2e}").translate(MINUS)
    return f"{value:.{digits}g}".translate(MINUS)


@cache
def _pages(folder: Path) -> jinja2.Environment:
    """Templates of a folder, and those that all pages share."""
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
    """What would turn the text around it, or end it, is shown as `\\u202e`."""
    return value if isinstance(value, Markup) or not isinstance(value, str) else printable(value, KEPT)


def _harmless(value: Any) -> Any:
    if isinstance(value, str):
        return escape(printable(value), quote=False)
    if isinstance(value, dict):
        return {key: _harmless(item) for key, item in value.items()}
    return [_harmless(item) for item in value] if isinstance(value, list) else value


def _text(*paths: Path) -> str:
    return "".join(path.read_text(encoding="utf-8") for path in paths)
