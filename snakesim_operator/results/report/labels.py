"""Puts labels where they cover neither each other nor the arrows: of eight places around a point, the barest."""

import math

from snakesim_operator.results.report.svg import Point, text, text_width

SIZE = 13.0
TURNS_DEG = (-90, 90, -45, -135, 45, 135, 0, 180)
Box = tuple[float, float, float, float]  # left, top, right, bottom


class Labels:
    """The labels of one drawing."""

    def __init__(self, width: float, height: float) -> None:
        self._frame: Box = (2.0, 2.0, width - 2.0, height - 2.0)
        self._taken: list[tuple[Box, float]] = []

    def keep_off(self, box: Box, weight: float = 1.0) -> None:
        """Something is drawn here."""
        self._taken.append((box, weight))

    def keep_off_line(self, a: Point, b: Point, half: float = 4.0, weight: float = 1.0) -> None:
        """A line is drawn from a to b."""
        steps = max(int(math.hypot(b[0] - a[0], b[1] - a[1]) / (2 * half)), 1)
        for k in range(steps + 1):
            x, y = a[0] + (b[0] - a[0]) * k / steps, a[1] + (b[1] - a[1]) * k / steps
            self._taken.append(((x - half, y - half, x + half, y + half), weight))

    def put(
        self,
        at: Point,
        words: str,
        class_: str,
        *,
        gaps: tuple[float, ...] = (12, 20, 30, 44),
        away_from: Point | None = None,
    ) -> str:
        """A label near a point, at the distance and in the direction that covers least."""
        width = text_width(words, SIZE)
        places: list[tuple[float, Box]] = []
        for gap in gaps:
            for turn in TURNS_DEG:
                c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
                x, y = at[0] + c * (gap + width / 2), at[1] + s * (gap + SIZE / 2)
                box = (x - width / 2, y - SIZE / 2, x + width / 2, y + SIZE / 2)
                places.append((self._cost(box) + 0.15 * gap + _towards(at, (c, s), away_from), box))
        _, box = min(places, key=lambda place: place[0])
        self.keep_off(box, 4.0)
        return text((box[0] + box[2]) / 2, box[3] - 2.5, words, class_, anchor="middle")

    def _cost(self, box: Box) -> float:
        covered = sum(weight * _overlap(box, taken) for taken, weight in self._taken)
        area = (box[2] - box[0]) * (box[3] - box[1])
        return covered + 10 * (area - _overlap(box, self._frame))


def _towards(at: Point, direction: Point, away_from: Point | None) -> float:
    """Cost of a direction that leads towards a point that the label had better keep away from."""
    if away_from is None:
        return 0.0
    x, y = away_from[0] - at[0], away_from[1] - at[1]
    return 60 * (direction[0] * x + direction[1] * y) / max(math.hypot(x, y), 1e-9)


def _overlap(a: Box, b: Box) -> float:
    wide = min(a[2], b[2]) - max(a[0], b[0])
    high = min(a[3], b[3]) - max(a[1], b[1])
    return max(wide, 0.0) * max(high, 0.0)
