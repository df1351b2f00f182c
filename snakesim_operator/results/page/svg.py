"""Drawings of the snake and its forces as SVG: elements with escaped text and finite numbers, and arrows.

All drawings on web pages are made here; charts over time are Plotly's (`charts`). On a report, figure.css and
`palette` define how a class of elements looks. The console's page has no such style sheet, so it passes colors.
"""

import math
from html import escape

from snakesim_hal.base.terminal import escape_invisible

Point = tuple[float, float]
Attribute = str | float | int | None

SHAFT_WIDTH = 3.0  # of an arrow that no style sheet draws


def number(value: float) -> str:
    """Return a coordinate as text, to a tenth of a unit.

    Raises:
        ValueError: It is not finite, so that a browser would draw nothing.
    """
    if not math.isfinite(value):
        raise ValueError(f"a coordinate of a figure is {value}; leave the element out instead")
    text = f"{value:.1f}"
    return "0" if text in ("-0.0", "0.0") else text.removesuffix(".0")


def element(name: str, *children: str, **attributes: Attribute) -> str:
    """Return an element around children that are markup already.

    An attribute `class_` becomes class, `stroke_width` becomes stroke-width. None is left out.
    """
    parts = [name]
    for key, value in attributes.items():
        if value is None:
            continue
        shown = escape(escape_invisible(value)) if isinstance(value, str) else number(value)
        parts.append(f'{key.rstrip("_").replace("_", "-")}="{shown}"')
    opening = " ".join(parts)
    return f"<{opening}>{''.join(children)}</{name}>" if children else f"<{opening}/>"


def text(x: float, y: float, words: str, class_: str = "", *, anchor: str = "start", **attributes: Attribute) -> str:
    """Return a line of text. anchor: start, middle or end. attributes: such as `fill`, where no style sheet has it."""
    return element(
        "text",
        escape(escape_invisible(words), quote=False),
        x=x,
        y=y,
        class_=class_ or None,
        text_anchor=None if anchor == "start" else anchor,
        **attributes,
    )


def title(words: str) -> str:
    """Return the tooltip of the element around it."""
    return element("title", escape(escape_invisible(words), quote=False))


def line(a: Point, b: Point, class_: str = "", **attributes: Attribute) -> str:
    """Return a straight line. attributes: such as `stroke`, where no style sheet has the class."""
    return element("line", x1=a[0], y1=a[1], x2=b[0], y2=b[1], class_=class_ or None, **attributes)


def points_text(points: list[Point]) -> str:
    """Return points as the value of a `points` attribute."""
    return " ".join(f"{number(x)},{number(y)}" for x, y in points)


def polyline(points: list[Point], class_: str) -> str:
    """Return an open line through points."""
    return element("polyline", points=points_text(points), class_=class_)


def arrow(tail: Point, tip: Point, class_: str = "", *, head: float = 9.0, color: str | None = None) -> str:
    """Return SVG for an arrow of a shaft and a filled head, or for a dot if the arrow would be too short.

    Args:
        tail: Where the arrow begins.
        tip: Where the arrow ends.
        class_: CSS class of the arrow.
        head: Maximum length of the head.
        color: Color, for drawings whose style sheet does not have the class; None: as in the style sheet.
    """
    dx = tip[0] - tail[0]
    dy = tip[1] - tail[1]
    length = math.hypot(dx, dy)
    if length < 1.5:
        return element("circle", cx=tip[0], cy=tip[1], r=1.5, class_=f"{class_} head", fill=color)

    # Unit vector along the arrow.
    ux = dx / length
    uy = dy / length

    # The head is a triangle: its tip, and two corners at its back.
    head_length = min(head, length / 1.1)
    half_width = 0.38 * head_length
    back_x = tip[0] - ux * head_length
    back_y = tip[1] - uy * head_length
    left = (back_x - uy * half_width, back_y + ux * half_width)
    right = (back_x + uy * half_width, back_y - ux * half_width)
    head_shape = element("polygon", points=points_text([tip, left, right]), class_=f"{class_} head", fill=color)

    # The shaft ends a little inside the head, so that no gap shows between them.
    shaft_end = (tip[0] - ux * head_length * 0.8, tip[1] - uy * head_length * 0.8)
    stroke_width = None if color is None else SHAFT_WIDTH
    shaft = line(tail, shaft_end, f"{class_} shaft", stroke=color, stroke_width=stroke_width)
    return shaft + head_shape


def figure(width: float, height: float, label: str, *children: str) -> str:
    """Return a whole drawing. label: what it shows, for people who cannot see it."""
    return element(
        "svg",
        *children,
        viewBox=f"0 0 {number(width)} {number(height)}",
        class_="figure",
        role="img",
        aria_label=label,
        style=f"max-width:{number(width)}px",
    )


def text_width(words: str, size: float = 13.0) -> float:
    """Estimate the width of a text, rather too wide than too narrow, to place labels."""
    return 0.58 * size * len(words)


def round_below(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above `value`."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= value * (1 + 1e-9))


def scale_bar(x: float, y: float, length: float, words: str, class_: str = "bar") -> str:
    """Return a bar of known length, with its meaning beside it."""
    ends = line((x, y - 4), (x, y + 4), class_) + line((x + length, y - 4), (x + length, y + 4), class_)
    return line((x, y), (x + length, y), class_) + ends + text(x + length + 7, y + 4.5, words, "small")
