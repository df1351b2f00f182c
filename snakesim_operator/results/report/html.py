"""HTML by hand: everything that came from outside is escaped here."""

from collections.abc import Callable, Sequence
from html import escape

from snakesim_hal.terminal import printable

KEPT = "\n\u202f\u00a0"  # line breaks of a configuration, and the blanks in large numbers
MINUS_SAFE = str.maketrans({"-": "−"})


def words(value: object) -> str:
    """Text, escaped; what would turn the text around it, or end it, is shown as `\\u202e`."""
    return escape(printable(str(value), KEPT))


def paragraph(value: str, class_: str = "") -> str:
    """A paragraph of plain text."""
    return f"<p{_class(class_)}>{words(value)}</p>"


def absent(why: str) -> str:
    """Stands where a section has nothing to show, and says why."""
    return paragraph(why, "absent")


def section(anchor: str, title: str, *parts: str) -> str:
    """A section of the page with its heading."""
    return f'<section id="{words(anchor)}"><h2>{words(title)}</h2>{"".join(parts)}</section>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], class_: str = "") -> str:
    """A table of plain text; the first column names the row."""
    top = "".join(f'<th scope="col">{words(name)}</th>' for name in head)
    body: list[str] = []
    for row in rows:
        cells = "".join(f"<td>{words(cell)}</td>" for cell in row[1:])
        body.append(f'<tr><th scope="row">{words(row[0])}</th>{cells}</tr>')
    return (
        f'<div class="scroll"><table{_class(class_)}><thead><tr>{top}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def tile(name: str, value: str, unit: str = "", *, alarming: bool = False) -> str:
    """A key number; a dash stands for what is unknown, and has no unit."""
    small = f"<small>{words(unit)}</small>" if unit and value != "–" else ""
    class_ = "tile alarming" if alarming else "tile"
    return f'<div class="{class_}"><b>{words(value)}{small}</b><span>{words(name)}</span></div>'


def document(title: str, style: str, body: str, script: str) -> str:
    """A whole page that needs no other file. style, body and script are markup already."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><title>{words(title)} – SnakeSIM</title>'
        f"<style>{style}</style></head><body><main>{body}</main><script>{script}</script></body></html>\n"
    )


def responsive(draw: Callable[[float], str], wide: float = 1040.0, narrow: float = 440.0) -> str:
    """A drawing made twice, for wide screens and paper and for phones, so that its text keeps its size."""
    return f'<div class="for-wide">{draw(wide)}</div><div class="for-narrow">{draw(narrow)}</div>'


def shown(value: float, digits: int = 4) -> str:
    """A number for people: so many significant digits, a real minus sign."""
    if value != 0 and (abs(value) >= 10**digits or abs(value) < 1e-4):
        whole = f"{value:,.0f}".replace(",", "\u202f")
        return (whole if abs(value) >= 1 else f"{value:.2e}").translate(MINUS_SAFE)
    return f"{value:.{digits}g}".translate(MINUS_SAFE)


def _class(class_: str) -> str:
    return f' class="{class_}"' if class_ else ""
