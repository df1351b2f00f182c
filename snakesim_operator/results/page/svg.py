"""Drawings of the snake and its forces as SVG: elements with escaped text and finite numbers, and arrows.

All drawings on web pages are made here; charts over time are Plotly's (`charts`). On a report, figure.css and
`palette` define how a class of elements looks. The console's page has no such style sheet, so it passes colors.
"""

import math
from html import escape

from snakesim_hal.base.terminal import escape_invisible

Point = tuple[float, float]
Attribute = str | float | int | None

SHAFT_WIDTH = 3.0  # of an arrow on a page without the style sheet


def format_coordinate(value: float) -> str:
    """Format a coordinate with a tenth of a unit.

    Raises:
        ValueError: The value is not finite; a browser would draw nothing.
    """
    if not math.isfinite(value):
        raise ValueError(f"a coordinate of a figure is {value}; leave the element out instead")
    formatted = f"{value:.1f}"
    return "0" if formatted in ("-0.0", "0.0") else formatted.removesuffix(".0")


def make_element(name: str, *children: str, **attributes: Attribute) -> str:
    """Make an SVG element.

    Args:
        name: Name of the element, such as "line".
        *children: Markup inside the element, which is not escaped.
        **attributes: Attributes; `class_` becomes `class`, and `stroke_width` becomes `stroke-width`. An attribute that
            is None is left out.
    """
    parts = [name]
    for key, value in attributes.items():
        if value is None:
            continue
        shown = (
            escape(escape_invisible(value)) if isinstance(value, str) else format_coordinate(value)
        )
        parts.append(f'{key.rstrip("_").replace("_", "-")}="{shown}"')
    opening = " ".join(parts)
    return f"<{opening}>{''.join(children)}</{name}>" if children else f"<{opening}/>"


def draw_text(
    x: float,
    y: float,
    words: str,
    class_: str = "",
    *,
    anchor: str = "start",
    **attributes: Attribute,
) -> str:
    """Draw a line of text.

    Args:
        x: Horizontal position of the anchor.
        y: Vertical position of the baseline.
        words: The text, which is escaped.
        class_: CSS classes; empty for none.
        anchor: Which part of the text is at `x`: "start", "middle" or "end".
        **attributes: Further attributes, such as `fill` on pages without the style sheet.
    """
    return make_element(
        "text",
        escape(escape_invisible(words), quote=False),
        x=x,
        y=y,
        class_=class_ or None,
        text_anchor=None if anchor == "start" else anchor,
        **attributes,
    )


def make_tooltip(words: str) -> str:
    """Make a tooltip, to be used as a child of the element that shows it."""
    return make_element("title", escape(escape_invisible(words), quote=False))


def draw_line(a: Point, b: Point, class_: str = "", **attributes: Attribute) -> str:
    """Draw a straight line from a to b, with further attributes such as `stroke` on pages without the style sheet."""
    return make_element(
        "line", x1=a[0], y1=a[1], x2=b[0], y2=b[1], class_=class_ or None, **attributes
    )


def format_points(points: list[Point]) -> str:
    """Format points as the value of a `points` attribute."""
    return " ".join(f"{format_coordinate(x)},{format_coordinate(y)}" for x, y in points)


def draw_polyline(points: list[Point], class_: str) -> str:
    """Draw an open line through points."""
    return make_element("polyline", points=format_points(points), class_=class_)


def draw_arrow(
    tail: Point, tip: Point, class_: str = "", *, head: float = 9.0, color: str | None = None
) -> str:
    """Draw an arrow with a shaft and a filled head, or a dot if the arrow would be too short.

    Args:
        tail: Point at which the arrow starts.
        tip: Point at which the arrow ends.
        class_: CSS class of the arrow.
        head: Maximum length of the head, in units of the drawing.
        color: Color for pages without the style sheet; None to use the color of the style sheet.
    """
    dx = tip[0] - tail[0]
    dy = tip[1] - tail[1]
    length = math.hypot(dx, dy)
    if length < 1.5:
        return make_element(
            "circle", cx=tip[0], cy=tip[1], r=1.5, class_=f"{class_} head", fill=color
        )

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
    head_shape = make_element(
        "polygon", points=format_points([tip, left, right]), class_=f"{class_} head", fill=color
    )

    # The shaft ends a little inside the head, so that no gap shows between them.
    shaft_end = (tip[0] - ux * head_length * 0.8, tip[1] - uy * head_length * 0.8)
    stroke_width = None if color is None else SHAFT_WIDTH
    shaft = draw_line(tail, shaft_end, f"{class_} shaft", stroke=color, stroke_width=stroke_width)
    return shaft + head_shape


def make_svg(width: float, height: float, label: str, *children: str) -> str:
    """Make a complete SVG drawing of a size around its children; `label` describes it for screen readers."""
    return make_element(
        "svg",
        *children,
        viewBox=f"0 0 {format_coordinate(width)} {format_coordinate(height)}",
        class_="figure",
        role="img",
        aria_label=label,
        style=f"max-width:{format_coordinate(width)}px",
    )


def estimate_text_width(words: str, size: float = 13.0) -> float:
    """Estimate the width of a text of a font size, in units of the drawing. The estimate is rather too wide."""
    return 0.58 * size * len(words)


def round_down_to_1_2_5(value: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= value * (1 + 1e-9))


def draw_scale_bar(x: float, y: float, length: float, words: str, class_: str = "bar") -> str:
    """Draw a scale bar with its text beside it; (x, y) is its left end."""
    ends = draw_line((x, y - 4), (x, y + 4), class_) + draw_line(
        (x + length, y - 4), (x + length, y + 4), class_
    )
    return (
        draw_line((x, y), (x + length, y), class_)
        + ends
        + draw_text(x + length + 7, y + 4.5, words, "small")
    )
