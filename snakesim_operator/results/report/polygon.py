"""The force polygon (paper, Fig. 10): the commanded force, the contact forces head to tail, and their resultant."""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire.messages import WorldContact
from snakesim_operator.results.report.instants import Balance
from snakesim_operator.results.report.labels import Labels
from snakesim_operator.results.report.svg import Point, arrow, element, figure, points_text, round_below, scale_bar

EDGE, FOOT = 46.0, 16.0


def units_per_n(balances: list[Balance], width: float, height: float, *, upright: bool = False) -> float:
    """The scale at which each of them fits, so that all can be drawn alike."""
    spans = np.array([np.ptp(_turned(one, upright), axis=0) for one in balances])
    across, tall = np.maximum(spans.max(axis=0), 1e-9)
    return float(min((width - 2 * EDGE) / across, (height - 2 * EDGE * 0.7) / tall))


def force_polygon(
    balance: Balance, felt: list[WorldContact], width: float, height: float, scale: float, *, upright: bool = False
) -> str:
    """A drawing. felt: measured then; scale: units per newton; upright: turned by a quarter, as the view beside it."""
    kinds, sum_kind = balance.force_classes(felt)
    corners_n = _turned(balance, upright)
    middle = (corners_n.min(axis=0) + corners_n.max(axis=0)) / 2
    corners: list[Point] = [
        (float(width / 2 + scale * (x - middle[0])), float((height - FOOT) / 2 - scale * (y - middle[1])))
        for x, y in corners_n
    ]
    labels = Labels(width, height - FOOT)
    for a, b in pairwise(corners):
        labels.keep_off_line(a, b, 5)
    ring = corners[:-1] if balance.gap_n * scale < 2 else corners
    parts = [element("polygon", points=points_text(ring), class_="polygon-fill")]
    parts.append(arrow(corners[1], corners[0], "commanded", head=11))
    for (a, b), kind in zip(pairwise(corners[1:]), kinds, strict=True):
        parts.append(arrow(a, b, kind, head=11))
    parts.append(_resultant(corners, sum_kind, labels))
    names = ["F", *(pretty(f"f_{i + 1}") for i in range(len(balance.contacts)))]
    inside = (sum(x for x, _ in corners) / len(corners), sum(y for _, y in corners) / len(corners))
    sizes = [balance.commanded_n, *balance.size_n]
    for name, size, a, b in zip(names, sizes, corners[:-1], corners[1:], strict=True):
        class_ = "halo commanded-text" if name == "F" else "halo solved-text"
        at = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2
        parts.append(labels.put(at, f"{name} {size:.0f} N", class_, gaps=(5, 9, 14, 22), away_from=inside))
    newtons = round_below(0.3 * width / scale)
    parts.append(scale_bar(8, height - 8, newtons * scale, f"{newtons:g} N", "force-bar"))
    words = f"Force polygon of {len(balance.contacts)} contact forces; it closes to {balance.gap_n:.2g} N"
    return figure(width, height, words, *parts)


def _turned(balance: Balance, upright: bool) -> NDArray[np.float64]:
    corners_n = balance.corners_n
    return np.column_stack([corners_n[:, 1], -corners_n[:, 0]]) if upright else corners_n


def pretty(name: str) -> str:
    """f_1 as f₁."""
    digits = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
    base, _, index = name.partition("_")
    return base + index.translate(digits)


def _resultant(corners: list[Point], kind: str, labels: Labels) -> str:
    """From the first contact force to the end of the last; set off to the outside, for it lies on the commanded one."""
    start, end = corners[1], corners[-1]
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    if length < 1e-6:
        return ""
    normal = (-(end[1] - start[1]) / length, (end[0] - start[0]) / length)
    center = (sum(x for x, _ in corners) / len(corners), sum(y for _, y in corners) / len(corners))
    inward = (center[0] - start[0]) * normal[0] + (center[1] - start[1]) * normal[1]
    off = -11.0 if inward > 0 else 11.0
    a = (start[0] + off * normal[0], start[1] + off * normal[1])
    b = (end[0] + off * normal[0], end[1] + off * normal[1])
    labels.keep_off_line(a, b, 6, 2.0)
    return arrow(a, b, kind, head=14)
