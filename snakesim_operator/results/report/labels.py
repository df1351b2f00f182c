"""Places labels where they cover neither each other nor the arrows: of eight places around a point, the emptiest."""

import math

from snakesim_operator.results.page.svg import Point, text, text_width

TEXT_HEIGHT = 13.0
DIRECTIONS_DEG = (-90, 90, -45, -135, 45, 135, 0, 180)  # of a place from its point; the first ones are preferred
LABEL_WEIGHT = 4.0  # a label on another label is unreadable
OUTSIDE_WEIGHT = 10.0  # a label that leaves the drawing is cut
GAP_WEIGHT = 0.15  # a near label is better than a far one
DIRECTION_WEIGHT = 60.0
Box = tuple[float, float, float, float]  # left, top, right, bottom


class Labels:
    """The labels of one drawing, and the areas that they must not cover."""

    def __init__(self, width: float, height: float) -> None:
        self._frame: Box = (2.0, 2.0, width - 2.0, height - 2.0)
        self._occupied: list[tuple[Box, float]] = []  # with the weight of each

    def keep_off(self, box: Box, weight: float = 1.0) -> None:
        """Keep later labels off a box in which something is drawn."""
        self._occupied.append((box, weight))

    def keep_off_line(self, a: Point, b: Point, half: float = 4.0, weight: float = 1.0) -> None:
        """Keep later labels off a line from a to b. half: half of its width."""
        steps = max(int(math.hypot(b[0] - a[0], b[1] - a[1]) / (2 * half)), 1)
        for k in range(steps + 1):
            x = a[0] + (b[0] - a[0]) * k / steps
            y = a[1] + (b[1] - a[1]) * k / steps
            self._occupied.append(((x - half, y - half, x + half, y + half), weight))

    def place_label(
        self,
        at: Point,
        words: str,
        class_: str,
        *,
        gaps: tuple[float, ...] = (12, 20, 30, 44),
        away_from: Point | None = None,
    ) -> str:
        """Return SVG for a label near a point, at the place of lowest cost among several distances and directions.

        A place costs more if the label would cover other items, be far from the point, or lie towards `away_from`.
        Later labels keep off the place that is chosen.

        Args:
            at: The point that the label names.
            words: The text.
            class_: CSS classes of the text.
            gaps: Distances from the point to try, in units of the drawing.
            away_from: A point in whose direction the label should not lie; None: any direction will do.
        """
        width = text_width(words, TEXT_HEIGHT)
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
                cost = self._covering_cost(box) + GAP_WEIGHT * gap + _direction_cost(at, (cos, sin), away_from)
                if cost < min_cost:
                    min_cost = cost
                    best_box = box
        self.keep_off(best_box, LABEL_WEIGHT)
        left, _, right, bottom = best_box
        return text((left + right) / 2, bottom - 2.5, words, class_, anchor="middle")

    def _covering_cost(self, box: Box) -> float:
        covered = sum(weight * _overlap(box, occupied) for occupied, weight in self._occupied)
        area = (box[2] - box[0]) * (box[3] - box[1])
        return covered + OUTSIDE_WEIGHT * (area - _overlap(box, self._frame))


def _direction_cost(at: Point, direction: Point, away_from: Point | None) -> float:
    """Return the cost of a direction that leads towards a point that the label should keep away from."""
    if away_from is None:
        return 0.0
    x = away_from[0] - at[0]
    y = away_from[1] - at[1]
    return DIRECTION_WEIGHT * (direction[0] * x + direction[1] * y) / max(math.hypot(x, y), 1e-9)


def _overlap(a: Box, b: Box) -> float:
    """Return the area that two boxes share."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0.0) * max(height, 0.0)
