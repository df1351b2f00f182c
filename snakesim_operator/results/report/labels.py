"""Places labels so that they cover neither each other nor arrows, at the emptiest of several positions near a point."""

import math

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.results.page.svg import Point, draw_text, estimate_text_width

TEXT_HEIGHT = 13.0
# Directions to try, from the named point to the label; the first ones are preferred.
DIRECTIONS_DEG = -90, 90, -45, -135, 45, 135, 0, 180
LABEL_WEIGHT = 4.0  # a label on another label is unreadable
OUTSIDE_WEIGHT = 10.0  # a label that leaves the drawing is cut
GAP_WEIGHT = 0.15  # a near label is better than a far one
DIRECTION_WEIGHT = 60.0
Box = tuple[float, float, float, float]  # left, top, right, bottom


class LabelPlacer:
    """Places the labels of one drawing, and stores the areas that later labels must not cover."""

    def __init__(self, width: float, height: float) -> None:
        self._frame: Box = (2.0, 2.0, width - 2.0, height - 2.0)
        self._occupied_boxes: list[Box] = []
        self._weights: list[float] = []  # of each occupied box: the cost of covering it, per area

    def reserve_box(self, box: Box, weight: float = 1.0) -> None:
        """Keep later labels away from a box. `weight` is the cost of covering it, per area."""
        self._occupied_boxes.append(box)
        self._weights.append(weight)

    def reserve_line(
        self, a: Point, b: Point, half_width: float = 4.0, weight: float = 1.0
    ) -> None:
        """Keep later labels away from a line from a to b. `weight` is the cost of covering it, per area."""
        steps = max(int(math.hypot(b[0] - a[0], b[1] - a[1]) / (2 * half_width)), 1)
        for k in range(steps + 1):
            x = a[0] + (b[0] - a[0]) * k / steps
            y = a[1] + (b[1] - a[1]) * k / steps
            self.reserve_box(
                (x - half_width, y - half_width, x + half_width, y + half_width), weight
            )

    def place_label(
        self,
        at: Point,
        words: str,
        class_: str,
        *,
        gaps: tuple[float, ...] = (12, 20, 30, 44),
        away_from: Point | None = None,
    ) -> str:
        """Draw a label near a point, at the position of lowest cost among several distances and directions.

        A position costs more if the label would cover other items, be far from the point, or lie towards `away_from`.
        Later labels avoid the chosen position.

        Args:
            at: The point that the label belongs to.
            words: The text.
            class_: CSS classes of the text.
            gaps: Distances from the point to try, in units of the drawing.
            away_from: Point in whose direction the label should not lie; None for no preference.

        Returns:
            The label as SVG.
        """
        width = estimate_text_width(words, TEXT_HEIGHT)
        boxes: list[Box] = []
        position_costs: list[float] = []
        for gap in gaps:
            for direction_deg in DIRECTIONS_DEG:
                cos = math.cos(math.radians(direction_deg))
                sin = math.sin(math.radians(direction_deg))
                center_x = at[0] + cos * (gap + width / 2)
                center_y = at[1] + sin * (gap + TEXT_HEIGHT / 2)
                left = center_x - width / 2
                top = center_y - TEXT_HEIGHT / 2
                boxes.append((left, top, center_x + width / 2, center_y + TEXT_HEIGHT / 2))
                direction_cost = _compute_direction_cost(at, (cos, sin), away_from)
                position_costs.append(GAP_WEIGHT * gap + direction_cost)
        costs = self._compute_covering_costs(np.array(boxes)) + position_costs
        best_box = boxes[int(np.argmin(costs))]
        self.reserve_box(best_box, LABEL_WEIGHT)
        left, _, right, bottom = best_box
        return draw_text((left + right) / 2, bottom - 2.5, words, class_, anchor="middle")

    def _compute_covering_costs(self, boxes: Floats) -> Floats:
        """Return the cost of a label in each box: the weighted areas that it covers, and its area outside the drawing.

        Args:
            boxes: Possible boxes of the label, shape (n, 4).

        Returns:
            Costs, shape (n,).
        """
        occupied = np.array(self._occupied_boxes).reshape(-1, 4)
        covered = (_compute_overlap_areas(boxes, occupied) * self._weights).sum(axis=1)
        areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
        areas_inside = _compute_overlap_areas(boxes, np.array([self._frame]))[:, 0]
        return covered + OUTSIDE_WEIGHT * (areas - areas_inside)


def _compute_direction_cost(at: Point, direction: Point, away_from: Point | None) -> float:
    """Return the cost of a direction: positive towards the point `away_from`, negative away from it."""
    if away_from is None:
        return 0.0
    x = away_from[0] - at[0]
    y = away_from[1] - at[1]
    return DIRECTION_WEIGHT * (direction[0] * x + direction[1] * y) / max(math.hypot(x, y), 1e-9)


def _compute_overlap_areas(a: Floats, b: Floats) -> Floats:
    """Return the area that each of n boxes shares with each of m boxes, shape (n, m)."""
    widths = np.minimum.outer(a[:, 2], b[:, 2]) - np.maximum.outer(a[:, 0], b[:, 0])
    heights = np.minimum.outer(a[:, 3], b[:, 3]) - np.maximum.outer(a[:, 1], b[:, 1])
    return np.maximum(widths, 0.0) * np.maximum(heights, 0.0)
