"""Draws boxes and arrows as SVG, in one style and with one set of colors, for the diagrams of the documentation."""

from collections.abc import Sequence
from html import escape

Point = tuple[float, float]

STYLE = """\
    .bg{fill:#ffffff}.plain{fill:#f4f6f8;stroke:#4a5560;stroke-width:1.4}.computer{fill:#e7f0fb;stroke:#1f5fa8;stroke-width:1.6}
    .drive{fill:#fdf3e3;stroke:#a8691f;stroke-width:1.4}.yours{fill:#eaf6ec;stroke:#2b7a3d;stroke-width:1.8}
    .stop{fill:#fdeaea;stroke:#b3261e;stroke-width:1.8}.t{fill:#1c242c}.s{fill:#55616d;font-size:12px}.b{font-weight:600}
    .a{stroke:#4a5560;stroke-width:1.6;fill:none}.bus{stroke:#1f5fa8;stroke-width:3;fill:none}
    .power{stroke:#b3261e;stroke-width:2.4;fill:none}.no{stroke:#b3261e;stroke-width:1.6;fill:none;stroke-dasharray:5 4}
    .head{marker-end:url(#m)}.zone{fill:#eaf6ec}.far{fill:#fdeaea}"""
MARKER = (
    '<defs><marker id="m" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
    'orient="auto-start-reverse"><path d="M0 0 10 5 0 10z" fill="#4a5560"/></marker></defs>'
)
LINE_PX = 18  # height of a line of text


class Drawing:
    """A picture in SVG with a white ground, so that it is readable on a dark page too."""

    def __init__(self, width: int, height: int, title: str) -> None:
        """Begin an empty picture.

        Args:
            width: Width in pixels.
            height: Height in pixels.
            title: What the picture shows, for readers who do not see it.
        """
        self._width = width
        self._height = height
        self._title = title
        self._parts: list[str] = []

    def box(
        self, x: float, y: float, width: float, height: float, text: str, kind: str = "plain"
    ) -> None:
        """Draw a box with centered text: the first line is bold, and the others are small.

        Args:
            x: Left side.
            y: Top side.
            width: Width in pixels.
            height: Height in pixels.
            text: Lines of text.
            kind: "plain", "computer", "drive", "yours" or "stop".
        """
        self._parts.append(
            f'<rect class="{kind}" x="{x}" y="{y}" width="{width}" height="{height}" rx="8"/>'
        )
        lines = text.split("\n")
        top = y + height / 2 - LINE_PX * (len(lines) - 1) / 2 + 5
        for number, line in enumerate(lines):
            style = "t b" if number == 0 else "s"
            self._parts.append(_text(x + width / 2, top + number * LINE_PX, line, style, "middle"))

    def fill(self, x: float, y: float, width: float, height: float, kind: str) -> None:
        """Draw an area without a border, of the kind "zone" or "far"."""
        self._parts.append(
            f'<rect class="{kind}" x="{x}" y="{y}" width="{width}" height="{height}"/>'
        )

    def line(self, *points: Point, kind: str = "a", arrow: bool = False) -> None:
        """Draw a line of the kind "a", "bus", "power" or "no" along some points."""
        path = " ".join(f"{x},{y}" for x, y in points)
        self._parts.append(f'<polyline class="{kind}{" head" if arrow else ""}" points="{path}"/>')

    def text(self, x: float, y: float, text: str, kind: str = "s", anchor: str = "start") -> None:
        """Draw lines of text; anchor: "start", "middle" or "end"."""
        for number, line in enumerate(text.split("\n")):
            self._parts.append(_text(x, y + number * LINE_PX, line, kind, anchor))

    def to_svg(self) -> str:
        """Return the drawing as the text of an SVG file."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self._width} {self._height}" '
            f'width="{self._width}" height="{self._height}" role="img" aria-label="{escape(self._title)}" '
            'font-family="system-ui, -apple-system, \'Segoe UI\', sans-serif" font-size="14">\n'
            f"  <style>\n{STYLE}\n  </style>\n  {MARKER}\n"
            f'  <rect class="bg" width="{self._width}" height="{self._height}"/>\n'
            + "".join(f"  {part}\n" for part in self._parts)
            + "</svg>\n"
        )


def _text(x: float, y: float, line: str, kind: str, anchor: str) -> str:
    return f'<text class="{kind}" x="{x:g}" y="{y:g}" text-anchor="{anchor}">{escape(line)}</text>'


def spread(first: float, last: float, count: int) -> Sequence[float]:
    """Return evenly spaced numbers from the first to the last."""
    return [first + (last - first) * i / (count - 1) for i in range(count)]
