"""Draws the force polygon (Fig. 10 of the paper): commanded force, contact forces one after another, resultant."""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire.messages import WorldContact
from snakesim_operator.results.page.svg import (
    Point,
    draw_arrow,
    draw_scale_bar,
    format_points,
    make_element,
    make_svg,
    round_down_to_1_2_5,
)
from snakesim_operator.results.report.labels import LabelPlacer
from snakesim_operator.results.report.snapshots import ForceBalance

MARGIN = 46.0  # around the polygon, for labels
FOOTER_HEIGHT = 16.0  # under it, for the scale
RESULTANT_OFFSET = 11.0  # from the commanded force, on which the resultant would lie
CLOSED_UNITS = 2.0  # a smaller gap in the polygon is invisible
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def find_common_force_scale(
    balances: list[ForceBalance], width: float, height: float, *, upright: bool = False
) -> float:
    """Find the scale, in units of the drawing per newton, at which the polygons of all balances fit the drawing."""
    spans = np.array([np.ptp(_rotate_corners_n(balance, upright), axis=0) for balance in balances])
    widest_n, tallest_n = np.maximum(spans.max(axis=0), 1e-9)
    return float(min((width - 2 * MARGIN) / widest_n, (height - 2 * MARGIN * 0.7) / tallest_n))


def draw_force_polygon(
    balance: ForceBalance,
    measured: list[WorldContact],
    width: float,
    height: float,
    scale: float,
    *,
    upright: bool = False,
) -> str:
    """Draw the force polygon as SVG: the commanded force and the contact forces, each from the tip of the one before.

    The polygon closes if the forces balance. An arrow beside it shows the resultant of the contact forces.

    Args:
        balance: The controller's desired forces.
        measured: Contacts that were measured at that time. A desired force without a measured contact is dashed.
        width: Width of the drawing.
        height: Height of the drawing.
        scale: Units of the drawing per newton.
        upright: Whether to rotate by a quarter turn, as the top view beside the polygon is.
    """
    contact_classes, resultant_class = balance.find_css_classes(measured)
    corners = _scale_corners(_rotate_corners_n(balance, upright), width, height, scale)
    labels = LabelPlacer(width, height - FOOTER_HEIGHT)
    for start, end in pairwise(corners):
        labels.reserve_line(start, end, 5)

    is_closed = balance.closure_error_n * scale < CLOSED_UNITS
    outline = corners[:-1] if is_closed else corners
    parts = [make_element("polygon", points=format_points(outline), class_="polygon-fill")]
    # The first side is the tether force; the commanded force points the other way.
    parts.append(draw_arrow(corners[1], corners[0], "commanded", head=11))
    contact_sides = pairwise(corners[1:])
    for (start, end), class_ in zip(contact_sides, contact_classes, strict=True):
        parts.append(draw_arrow(start, end, class_, head=11))
    parts.append(_draw_resultant(corners, resultant_class, labels))
    parts += _label_sides(balance, corners, labels)

    newtons = round_down_to_1_2_5(0.3 * width / scale)
    parts.append(draw_scale_bar(8, height - 8, newtons * scale, f"{newtons:g} N", "force-bar"))
    words = f"Force polygon of {len(balance.contacts)} contact forces; it closes to {balance.closure_error_n:.2g} N"
    return make_svg(width, height, words, *parts)


def format_subscript(name: str) -> str:
    """Format the index behind an underscore as a subscript: `f_1` becomes `f₁`."""
    base, _, index = name.partition("_")
    return base + index.translate(SUBSCRIPTS)


def _rotate_corners_n(balance: ForceBalance, upright: bool) -> NDArray[np.float64]:
    """Return the corners of the polygon in N, rotated by a quarter turn for an upright drawing."""
    corners_n = balance.corners_n
    if not upright:
        return corners_n
    return np.column_stack([corners_n[:, 1], -corners_n[:, 0]])


def _scale_corners(
    corners_n: NDArray[np.float64], width: float, height: float, scale: float
) -> list[Point]:
    """Convert corners from N to coordinates of the drawing, with the polygon in its middle."""
    middle = (corners_n.min(axis=0) + corners_n.max(axis=0)) / 2
    corners: list[Point] = []
    for x, y in corners_n:
        drawn_x = width / 2 + scale * (x - middle[0])
        drawn_y = (height - FOOTER_HEIGHT) / 2 - scale * (y - middle[1])
        corners.append((float(drawn_x), float(drawn_y)))
    return corners


def _find_center(corners: list[Point]) -> Point:
    x = sum(x for x, _ in corners) / len(corners)
    y = sum(y for _, y in corners) / len(corners)
    return x, y


def _label_sides(balance: ForceBalance, corners: list[Point], labels: LabelPlacer) -> list[str]:
    """Label each side outside the polygon with the name and magnitude of its force, the commanded force first."""
    names = ["F", *(format_subscript(f"f_{i + 1}") for i in range(len(balance.contacts)))]
    sizes_n = [balance.commanded_force_n, *balance.magnitudes_n]
    inside = _find_center(corners)
    parts: list[str] = []
    for name, size_n, a, b in zip(names, sizes_n, corners[:-1], corners[1:], strict=True):
        class_ = "halo commanded-text" if name == "F" else "halo solved-text"
        middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)
        label = labels.place_label(
            middle, f"{name} {size_n:.0f} N", class_, gaps=(5, 9, 14, 22), away_from=inside
        )
        parts.append(label)
    return parts


def _draw_resultant(corners: list[Point], class_: str, labels: LabelPlacer) -> str:
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
    center_x, center_y = _find_center(corners)
    center_distance = (center_x - start_x) * normal_x + (center_y - start_y) * normal_y
    offset = -RESULTANT_OFFSET if center_distance > 0 else RESULTANT_OFFSET
    shifted_start = (start_x + offset * normal_x, start_y + offset * normal_y)
    shifted_end = (end_x + offset * normal_x, end_y + offset * normal_y)
    labels.reserve_line(shifted_start, shifted_end, 6, 2.0)
    return draw_arrow(shifted_start, shifted_end, class_, head=14)
