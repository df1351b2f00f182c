"""Drawings of lines and text in mm, and their files: PDF with one page for each drawing, or one SVG.

Both formats are written directly, because lines in true scale and a standard font need no library.
"""

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np

from snakesim_hal.base.arrays import Floats

POINTS_PER_MM = 72 / 25.4
MEAN_GLYPH_WIDTH = 0.55  # of the height of the text; Helvetica
BLACK = 0.0
GRAY = 0.55


@dataclass(frozen=True)
class Stroke:
    """A line through points."""

    points_mm: Floats  # (n, 2): x to the right, y up
    width_mm: float = 0.35
    gray: float = BLACK  # 0 is black, 1 is white
    closed: bool = False
    dashed: bool = False


@dataclass(frozen=True)
class Label:
    """A line of text."""

    text: str
    position_mm: tuple[float, float]  # left end of the baseline, or its middle
    height_mm: float = 4.0
    gray: float = BLACK
    centered: bool = False


@dataclass(frozen=True)
class Window:
    """A rectangle in which a drawing is visible."""

    left_mm: float
    bottom_mm: float
    width_mm: float
    height_mm: float


@dataclass(frozen=True)
class Drawing:
    """Lines and text."""

    strokes: Sequence[Stroke] = ()
    labels: Sequence[Label] = ()

    def __add__(self, other: "Drawing") -> "Drawing":
        """Return a drawing with the content of both."""
        return Drawing((*self.strokes, *other.strokes), (*self.labels, *other.labels))

    @property
    def bounds_mm(self) -> tuple[Floats, Floats]:
        """The lower left and the upper right corner of all lines; text counts with the start of its baseline."""
        points = [stroke.points_mm for stroke in self.strokes]
        points += [np.array([label.position_mm]) for label in self.labels]
        stacked = np.concatenate(points)
        return stacked.min(axis=0), stacked.max(axis=0)

    def transform(self, shift_mm: Floats, scale: float = 1.0) -> "Drawing":
        """Return the drawing scaled about the origin, then shifted. Widths of lines stay."""
        strokes = [
            replace(stroke, points_mm=scale * stroke.points_mm + shift_mm)
            for stroke in self.strokes
        ]
        labels: list[Label] = []
        for label in self.labels:
            x_mm, y_mm = scale * np.array(label.position_mm) + shift_mm
            position_mm = (float(x_mm), float(y_mm))
            labels.append(
                replace(label, position_mm=position_mm, height_mm=scale * label.height_mm)
            )
        return Drawing(strokes, labels)


@dataclass(frozen=True)
class Page:
    """A sheet of paper with a drawing, of which a window may be visible, and a margin around it."""

    width_mm: float
    height_mm: float
    content: Drawing
    window: Window | None = None  # of the content; None: all of the page
    margin: Drawing = Drawing()  # is not cut off at the window


def encode_pdf(pages: Sequence[Page], title: str) -> bytes:
    """Return a PDF file in true scale.

    Args:
        pages: Its pages.
        title: Title that readers show.
    """
    page_ids = [4 + 2 * number for number in range(len(pages))]
    kids = " ".join(f"{page_id} 0 R" for page_id in page_ids)
    # `PrintScaling` asks print dialogs not to fit the page to the paper.
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for page_id, page in zip(page_ids, pages, strict=True):
        box = f"[0 0 {page.width_mm * POINTS_PER_MM:.3f} {page.height_mm * POINTS_PER_MM:.3f}]"
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents {page_id + 1} 0 R "
            f"/Resources << /Font << /F1 3 0 R >> >> >>".encode()
        )
        content = zlib.compress("\n".join(_list_pdf_operators(page)).encode("cp1252", "replace"))
        header = f"<< /Length {len(content)} /Filter /FlateDecode >>\nstream\n".encode()
        objects.append(header + content + b"\nendstream")
    objects.append(f"<< /Title ({_escape_pdf(title)}) >>".encode("cp1252", "replace"))
    return _join_pdf_objects(objects)


def _join_pdf_objects(objects: Sequence[bytes]) -> bytes:
    """Return a PDF file of these objects, numbered from 1. The first is the catalog, the last the information."""
    file = bytearray(b"%PDF-1.4\n")
    offsets: list[int] = []
    for number, content in enumerate(objects, start=1):
        offsets.append(len(file))
        file += f"{number} 0 obj\n".encode() + content + b"\nendobj\n"
    table_offset = len(file)
    file += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    for offset in offsets:
        file += f"{offset:010d} 00000 n \n".encode()
    trailer = f"<< /Size {len(objects) + 1} /Root 1 0 R /Info {len(objects)} 0 R >>"
    file += f"trailer\n{trailer}\nstartxref\n{table_offset}\n%%EOF\n".encode()
    return bytes(file)


def _list_pdf_operators(page: Page) -> Iterable[str]:
    """Yield the operators that draw a page, in mm."""
    yield f"{POINTS_PER_MM:.6f} 0 0 {POINTS_PER_MM:.6f} 0 0 cm 1 J 1 j"
    yield "q"
    if page.window is not None:
        window = page.window
        yield f"{window.left_mm:.3f} {window.bottom_mm:.3f} {window.width_mm:.3f} {window.height_mm:.3f} re W n"
    yield from _list_pdf_shapes(page.content)
    yield "Q"
    yield from _list_pdf_shapes(page.margin)


def _list_pdf_shapes(drawing: Drawing) -> Iterable[str]:
    for stroke in drawing.strokes:
        path = " ".join(
            f"{x:.3f} {y:.3f} {'l' if number else 'm'}"
            for number, (x, y) in enumerate(stroke.points_mm.tolist())
        )
        dash = "[3 2] 0 d" if stroke.dashed else "[] 0 d"
        yield f"{stroke.gray:g} G {stroke.width_mm:g} w {dash} {path} {'s' if stroke.closed else 'S'}"
    for label in drawing.labels:
        x_mm, y_mm = _get_text_start_mm(label)
        text = _escape_pdf(label.text)
        yield f"BT {label.gray:g} g /F1 {label.height_mm:.3f} Tf {x_mm:.3f} {y_mm:.3f} Td ({text}) Tj ET"


def _get_text_start_mm(label: Label) -> tuple[float, float]:
    x_mm, y_mm = label.position_mm
    if label.centered:
        x_mm -= len(label.text) * MEAN_GLYPH_WIDTH * label.height_mm / 2
    return x_mm, y_mm


def _escape_pdf(text: str) -> str:
    return text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")


def encode_svg(drawing: Drawing, title: str, border_mm: float = 10.0) -> str:
    """Return one SVG in true scale, for a plotter or a large printer.

    Args:
        drawing: Everything that it shows.
        title: Its title, also for readers that do not show pictures.
        border_mm: Empty border on all sides.
    """
    lowest, highest = drawing.bounds_mm
    left_mm, bottom_mm = (lowest - border_mm).tolist()
    right_mm, top_mm = (highest + border_mm).tolist()
    width_mm = math.ceil(right_mm - left_mm)
    height_mm = math.ceil(top_mm - bottom_mm)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width_mm}mm" height="{height_mm}mm" '
        f'viewBox="0 0 {width_mm} {height_mm}" font-family="Helvetica, Arial, sans-serif">',
        f"<title>{escape(title)}</title>",
        f'<rect width="{width_mm}" height="{height_mm}" fill="white"/>',
    ]
    for stroke in drawing.strokes:
        points = " ".join(
            f"{x - left_mm:.2f},{top_mm - y:.2f}" for x, y in stroke.points_mm.tolist()
        )
        tag = "polygon" if stroke.closed else "polyline"
        dash = ' stroke-dasharray="3 2"' if stroke.dashed else ""
        lines.append(
            f'<{tag} points="{points}" fill="none" stroke="{_format_gray(stroke.gray)}" '
            f'stroke-width="{stroke.width_mm:g}"{dash}/>'
        )
    for label in drawing.labels:
        x_mm, y_mm = label.position_mm
        anchor = ' text-anchor="middle"' if label.centered else ""
        lines.append(
            f'<text x="{x_mm - left_mm:.2f}" y="{top_mm - y_mm:.2f}" font-size="{label.height_mm:.2f}" '
            f'fill="{_format_gray(label.gray)}"{anchor}>{escape(label.text)}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


def _format_gray(gray: float) -> str:
    level = round(255 * gray)
    return f"#{level:02x}{level:02x}{level:02x}"
