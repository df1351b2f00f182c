"""Places labels so that they cover neither each other nor arrows, at the emptiest of several positions near a point."""

import math

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
        self._occupied: list[tuple[Box, float]] = []  # each with the cost weight of covering it

    def reserve_box(self, box: Box, weight: float = 1.0) -> None:
        """Keep later labels away from a box. `weight` is the cost of covering it, per area."""
        self._occupied.append((box, weight))

    def reserve_line(
        self, a: Point, b: Point, half_width: float = 4.0, weight: float = 1.0
    ) -> None:
        """Keep later labels away from a line from a to b. `weight` is the cost of covering it, per area."""
        steps = max(int(math.hypot(b[0] - a[0], b[1] - a[1]) / (2 * half_width)), 1)
        for k in range(steps + 1):
            x = a[0] + (b[0] - a[0]) * k / steps
            y = a[1] + (b[1] - a[1]) * k / steps
            self._occupied.append(
                ((x - half_width, y - half_width, x + half_width, y + half_width), weight)
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
        min_cost = math.inf
        best_box: Box = (0.0, 0.0, 0.0, 0.0)
        for gap in gaps:
            for direction_deg in DIRECTIONS_DEG:
                cos = math.cos(math.radians(direction_deg))
                sin = math.sin(math.radians(direction_deg))
                center_x = at[0] + cos * (gap + width / 2)
                center_y = at[1] + sin * (gap + TEXT_HEIGHT / 2)
                left = center_x - width / 2
                top = center_y - TEXT_HEIGHT / 2
                box = (left, top, center_x + width / 2, center_y + TEXT_HEIGHT / 2)
                cost = (
                    self._compute_covering_cost(box)
                    + GAP_WEIGHT * gap
                    + _compute_direction_cost(at, (cos, sin), away_from)
                )
                if cost < min_cost:
                    min_cost = cost
                    best_box = box
        self.reserve_box(best_box, LABEL_WEIGHT)
        left, _, right, bottom = best_box
        return draw_text((left + right) / 2, bottom - 2.5, words, class_, anchor="middle")

    def _compute_covering_cost(self, box: Box) -> float:
        """Return the cost of a label in a box: the weighted areas that it covers, and its area outside the drawing."""
        covered = sum(
            weight * _compute_overlap_area(box, occupied) for occupied, weight in self._occupied
        )
        area = (box[2] - box[0]) * (box[3] - box[1])
        return covered + OUTSIDE_WEIGHT * (area - _compute_overlap_area(box, self._frame))


def _compute_direction_cost(at: Point, direction: Point, away_from: Point | None) -> float:
    """Return the cost of a direction: positive towards the point `away_from`, negative away from it."""
    if away_from is None:
        return 0.0
    x = away_from[0] - at[0]
    y = away_from[1] - at[1]
    return DIRECTION_WEIGHT * (direction[0] * x + direction[1] * y) / max(math.hypot(x, y), 1e-9)


def _compute_overlap_area(a: Box, b: Box) -> float:
    """Return the area that two boxes share."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0.0) * max(height, 0.0)
