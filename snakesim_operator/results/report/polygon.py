"""The force polygon (paper, Fig. 10): f_s and the contact forces head to tail, and the resultant beside it."""

import math
from itertools import pairwise

import numpy as np

from snakesim_operator.results.report.instants import Balance
from snakesim_operator.results.report.labels import Labels
from snakesim_operator.results.report.svg import Point, arrow, element, figure, points_text

EDGE = 46.0


def force_polygon(balance: Balance, width: float, height: float, *, upright: bool = False) -> str:
    """A drawing of its own. upright: turned by a quarter, as the top view beside it."""
    words = f"Force polygon of f_s and {len(balance.contacts)} contact forces; it closes to {balance.gap_n:.2g} N"
    return figure(width, height, words, polygon_drawing(balance, width, height, upright=upright))


def polygon_drawing(balance: Balance, width: float, height: float, *, upright: bool = False) -> str:
    """Everything inside the drawing, fitted to it."""
    corners_n = balance.corners_n
    if upright:
        corners_n = np.column_stack([corners_n[:, 1], -corners_n[:, 0]])
    low, high = corners_n.min(axis=0), corners_n.max(axis=0)
    span = np.maximum(high - low, 1e-9)
    scale = float(min((width - 2 * EDGE) / span[0], (height - 2 * EDGE * 0.6) / span[1]))
    middle = (low + high) / 2
    corners: list[Point] = [
        (float(width / 2 + scale * (x - middle[0])), float(height / 2 - scale * (y - middle[1]))) for x, y in corners_n
    ]
    labels = Labels(width, height)
    for a, b in pairwise(corners):
        labels.keep_off_line(a, b, 5)
    ring = corners[:-1] if balance.gap_n * scale < 2 else corners
    parts = [element("polygon", points=points_text(ring), class_="polygon-fill")]
    parts.append(arrow(corners[0], corners[1], "tether", head=11))
    for a, b in pairwise(corners[1:]):
        parts.append(arrow(a, b, "solved", head=11))
    parts.append(_resultant(corners, labels))
    names = ["f_s", *(f"f_{i + 1}" for i in range(len(balance.contacts)))]
    inside = (sum(x for x, _ in corners) / len(corners), sum(y for _, y in corners) / len(corners))
    sizes = [float(np.hypot(*balance.tether_n)), *balance.size_n]
    for name, size, a, b in zip(names, sizes, corners[:-1], corners[1:], strict=True):
        class_ = "halo tether-text" if name == "f_s" else "halo solved-text"
        parts.append(
            labels.put(_mid(a, b), f"{pretty(name)} {size:.0f} N", class_, gaps=(5, 9, 14, 22), away_from=inside)
        )
    return "".join(parts)


def pretty(name: str) -> str:
    """f_1 as f₁."""
    digits = str.maketrans("0123456789s", "₀₁₂₃₄₅₆₇₈₉ₛ")
    base, _, index = name.partition("_")
    return base + index.translate(digits)


def _resultant(corners: list[Point], labels: Labels) -> str:
    """From the end of f_s to the end of the last force; set off to the outside, for it lies on f_s."""
    start, end = corners[1], corners[-1]
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    if length < 1e-6:
        return ""
    normal = (-(end[1] - start[1]) / length, (end[0] - start[0]) / length)
    centre = (sum(x for x, _ in corners) / len(corners), sum(y for _, y in corners) / len(corners))
    inward = (centre[0] - start[0]) * normal[0] + (centre[1] - start[1]) * normal[1]
    off = -11.0 if inward > 0 else 11.0
    a = (start[0] + off * normal[0], start[1] + off * normal[1])
    b = (end[0] + off * normal[0], end[1] + off * normal[1])
    labels.keep_off_line(a, b, 6, 2.0)
    return arrow(a, b, "resultant", head=14)


def _mid(a: Point, b: Point) -> Point:
    return (a[0] + b[0]) / 2, (a[1] + b[1]) / 2
