"""Renders HTML pages from templates. All values are escaped: in text by Jinja, in charts by `make_chart_markup`."""

from collections.abc import Sequence
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import jinja2
import msgspec
from markupsafe import Markup

from snakesim_hal.base.terminal import escape_invisible
from snakesim_operator.results.page.charts import LIBRARY, PlotlyDict
from snakesim_operator.results.page.palette import make_theme_css
from snakesim_operator.results.page.template_cache import TemplateCache

HERE = Path(__file__).parent
# Line breaks of a configuration, and the spaces in large numbers.
ALLOWED_CHARACTERS = "\n\u202f\u00a0"
MINUS = str.maketrans({"-": "−"})


def render_page(
    template: Path,
    colored_joints: int,
    *,
    styles: Sequence[Path] = (),
    scripts: Sequence[Path] = (),
    charts: bool = True,
    **values: Any,
) -> str:
    """Render an HTML page that needs no other file: styles, scripts and the plotting library are embedded.

    Args:
        template: Path of the Jinja template of the page.
        colored_joints: Number of joints that need a color of their own.
        styles: Paths of style sheets, in addition to the one that all pages share.
        scripts: Paths of scripts, in addition to that of the charts.
        charts: Whether the page has charts, which need the plotting library.
        **values: Variables of the template.
    """
    style = make_theme_css(colored_joints) + _read_texts(HERE / "page.css", *styles)
    library = ""
    chart_scripts: list[Path] = []
    if charts:
        library = _read_texts(LIBRARY)
        chart_scripts = [HERE / "charts.js"]
    page = _make_environment(template.parent).get_template(template.name)
    return page.render(
        style=Markup(style),
        library=Markup(library),
        script=Markup(_read_texts(*chart_scripts, *scripts)),
        **values,
    )


def make_chart_markup(figure: PlotlyDict) -> Markup:
    """Make the HTML element of a chart, with the data of the chart as JSON inside."""
    label = Markup.escape(escape_invisible(figure["label"]))
    return Markup(
        f'<figure class="chart" role="group" aria-label="{label}" style="min-height:{figure["layout"]["height"]}px">'
        f'<div class="plot"></div><div class="cursor"></div>{embed_json(figure)}</figure>'
    )


def embed_json(value: Any) -> Markup:
    """Embed a value as JSON for a script of the page. Its texts are escaped: they cannot act as markup."""
    encoded = msgspec.json.encode(_escape_texts(value)).decode().replace("<", "\\u003c")
    return Markup(f'<script type="application/json">{encoded}</script>')


def format_number(value: float, digits: int = 4) -> str:
    """Format a number for people, with a typographic minus sign, and without a sign before zero.

    Args:
        value: The number.
        digits: Number of significant digits.
    """
    value += 0.0  # turns -0.0 into 0.0
    if value != 0 and (abs(value) >= 10**digits or abs(value) < 1e-4):
        whole = f"{value:,.0f}".replace(",", "\u202f")
        return (whole if abs(value) >= 1 else f"{value:.2e}").translate(MINUS)
    return f"{value:.{digits}g}".translate(MINUS)


@cache
def _make_environment(folder: Path) -> jinja2.Environment:
    """Make the Jinja environment for the templates of a folder and those that all pages share."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, HERE]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_show_control_characters,
        trim_blocks=True,
        lstrip_blocks=True,
        # The options are those of this file.
        bytecode_cache=TemplateCache(options=_read_texts(Path(__file__))),
    )
    environment.filters.update(chart=make_chart_markup, data=embed_json, shown=format_number)
    return environment


def _show_control_characters(value: Any) -> Any:
    """Make control characters of a text visible: they could hide or reverse the text around them."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return escape_invisible(value, ALLOWED_CHARACTERS)
    return value


def _escape_texts(value: Any) -> Any:
    """Escape every text in a value, also in nested dictionaries and lists."""
    if isinstance(value, str):
        return escape(escape_invisible(value), quote=False)
    if isinstance(value, dict):
        return {key: _escape_texts(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_escape_texts(item) for item in value]
    return value


def _read_texts(*paths: Path) -> str:
    return "".join(path.read_text(encoding="utf-8") for path in paths)
