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
    """Draw the force polygon as SVG: the commanded force and the contact forces, each from the tip of the one before.

    The polygon closes if the forces balance. An arrow beside it shows the resultant of the contact forces.

    Args:
        balance: The controller's desired forces.
        measured: The contacts that were measured at the time; they decide how each force is drawn.
        width: Width of the drawing.
        height: Height of the drawing.
        scale: Units of the drawing per newton.
        upright: Whether to rotate by a quarter turn, as the top view beside the polygon is.
    """
    contact_classes, resultant_class = balance.force_classes(measured)
    corners = _place_corners(_drawn_corners_n(balance, upright), width, height, scale)
    labels = Labels(width, height - FOOT)
    for start, end in pairwise(corners):
        labels.keep_off_line(start, end, 5)

    is_closed = balance.gap_n * scale < CLOSED_UNITS
    outline = corners[:-1] if is_closed else corners
    parts = [element("polygon", points=points_text(outline), class_="polygon-fill")]
    # The first side is the tether force; the commanded force points the other way.
    parts.append(arrow(corners[1], corners[0], "commanded", head=11))
    contact_sides = pairwise(corners[1:])
    for (start, end), class_ in zip(contact_sides, contact_classes, strict=True):
        parts.append(arrow(start, end, class_, head=11))
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
    """Draw the resultant of the contact forces as an arrow beside the force polygon.

    The resultant goes from the start of the first contact force to the end of the last. There it would cover the
    commanded force, so the arrow is shifted by RESULTANT_OFFSET to the outside of the polygon.

    Args:
        corners: Corners of the polygon in the drawing; the first side is the commanded force.
        class_: CSS class of the arrow.
        labels: Labels of the drawing, which must not cover the arrow.

    Returns:
        The arrow as SVG; empty if the resultant is zero.
    """
    start_x, start_y = corners[1]
    end_x, end_y = corners[-1]
    dx = end_x - start_x
    dy = end_y - start_y
    length = math.hypot(dx, dy)
    if length < 1e-6:
        return ""
    normal_x = -dy / length
    normal_y = dx / length
    center_x, center_y = _center_of(corners)
    center_distance = (center_x - start_x) * normal_x + (center_y - start_y) * normal_y
    offset = -RESULTANT_OFFSET if center_distance > 0 else RESULTANT_OFFSET
    shifted_start = (start_x + offset * normal_x, start_y + offset * normal_y)
    shifted_end = (end_x + offset * normal_x, end_y + offset * normal_y)
    labels.keep_off_line(shifted_start, shifted_end, 6, 2.0)
    return arrow(shifted_start, shifted_end, class_, head=14)
