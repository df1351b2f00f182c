"""The force polygon (paper, Fig. 10): the commanded force, the contact forces head to tail, and their resultant."""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire.messages import WorldContact
from snakesim_operator.results.page.svg import Point, arrow, element, figure, points_text, round_below, scale_bar
from snakesim_operator.results.report.labels import Labels
from snakesim_operator.results.report.snapshots import Balance

EDGE = 46.0  # around the polygon, for labels
FOOT = 16.0  # under it, for the scale
RESULTANT_OFFSET = 11.0  # from the commanded force, on which the resultant would lie
CLOSED_UNITS = 2.0  # a smaller gap cannot be seen
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def common_scale(balances: list[Balance], width: float, height: float, *, upright: bool = False) -> float:
    """Return the units per newton at which every polygon fits into the drawing, so that all have one scale."""
    spans = np.array([np.ptp(_drawn_corners_n(balance, upright), axis=0) for balance in balances])
    widest_n, tallest_n = np.maximum(spans.max(axis=0), 1e-9)
    return float(min((width - 2 * EDGE) / widest_n, (height - 2 * EDGE * 0.7) / tallest_n))


def force_polygon(
    balance: Balance, measured: list[WorldContact], width: float, height: float, scale: float, *, upright: bool = False
) -> str:
    """Draw the force polygon.

    Args:
        balance: The solved forces.
        measured: The contacts that were measured at the time.
        width: Width of the drawing.
        height: Height of the drawing.
        scale: Units of the drawing per newton.
        upright: Rotate by a quarter, as the top view beside it.
    """
    contact_classes, resultant_class = balance.force_classes(measured)
    corners = _place_corners(_drawn_corners_n(balance, upright), width, height, scale)
    labels = Labels(width, height - FOOT)
    for a, b in pairwise(corners):
        labels.keep_off_line(a, b, 5)
    is_closed = balance.gap_n * scale < CLOSED_UNITS
    ring = corners[:-1] if is_closed else corners
    parts = [element("polygon", points=points_text(ring), class_="polygon-fill")]
    parts.append(arrow(corners[1], corners[0], "commanded", head=11))
    for (a, b), class_ in zip(pairwise(corners[1:]), contact_classes, strict=True):
        parts.append(arrow(a, b, class_, head=11))
    parts.append(_draw_resultant(corners, resultant_class, labels))
    parts += _draw_names(balance, corners, labels)
    newtons = round_below(0.3 * width / scale)
    parts.append(scale_bar(8, height - 8, newtons * scale, f"{newtons:g} N", "force-bar"))
    words = f"Force polygon of {len(balance.contacts)} contact forces; it closes to {balance.gap_n:.2g} N"
    return figure(width, height, words, *parts)


def with_subscript(name: str) -> str:
    """Return f_1 as f₁."""
    base, _, index = name.partition("_")
    return base + index.translate(SUBSCRIPTS)


def _drawn_corners_n(balance: Balance, upright: bool) -> NDArray[np.float64]:
    """Return the corners of the polygon in N, rotated by a quarter for an upright drawing."""
    corners_n = balance.corners_n
    if not upright:
        return corners_n
    return np.column_stack([corners_n[:, 1], -corners_n[:, 0]])


def _place_corners(corners_n: NDArray[np.float64], width: float, height: float, scale: float) -> list[Point]:
    """Return the corners in the drawing, with the polygon in its middle."""
    middle = (corners_n.min(axis=0) + corners_n.max(axis=0)) / 2
    corners: list[Point] = []
    for x, y in corners_n:
        drawn_x = width / 2 + scale * (x - middle[0])
        drawn_y = (height - FOOT) / 2 - scale * (y - middle[1])
        corners.append((float(drawn_x), float(drawn_y)))
    return corners


def _center_of(corners: list[Point]) -> Point:
    x = sum(x for x, _ in corners) / len(corners)
    y = sum(y for _, y in corners) / len(corners)
    return x, y


def _draw_names(balance: Balance, corners: list[Point], labels: Labels) -> list[str]:
    """Write name and size at each side, outside the polygon: the commanded force first, then the contact forces."""
    names = ["F", *(with_subscript(f"f_{i + 1}") for i in range(len(balance.contacts)))]
    sizes_n = [balance.commanded_n, *balance.size_n]
    inside = _center_of(corners)
    parts: list[str] = []
    for name, size_n, a, b in zip(names, sizes_n, corners[:-1], corners[1:], strict=True):
        class_ = "halo commanded-text" if name == "F" else "halo solved-text"
        middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)
        label = labels.place_label(middle, f"{name} {size_n:.0f} N", class_, gaps=(5, 9, 14, 22), away_from=inside)
        parts.append(label)
    return parts


def _draw_resultant(corners: list[Point], class_: str, labels: Labels) -> str:
    """Draw the resultant from the first contact force to the end of the last, outside the polygon.

    Without the offset it would lie on the commanded force.
    """
    start = corners[1]
    end = corners[-1]
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    if length < 1e-6:
        return ""
    normal = (-(end[1] - start[1]) / length, (end[0] - start[0]) / length)
    center = _center_of(corners)
    inward = (center[0] - start[0]) * normal[0] + (center[1] - start[1]) * normal[1]
    offset = -RESULTANT_OFFSET if inward > 0 else RESULTANT_OFFSET
    a = (start[0] + offset * normal[0], start[1] + offset * normal[1])
    b = (end[0] + offset * normal[0], end[1] + offset * normal[1])
    labels.keep_off_line(a, b, 6, 2.0)
    return arrow(a, b, class_, head=14)
