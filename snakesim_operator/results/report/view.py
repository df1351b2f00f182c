"""How the ground is laid on a drawing: which window, at what scale, and how long a force is drawn."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Obstacle
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import Instant
from snakesim_operator.results.report.svg import Point

LONGEST_ARROW = 72.0  # of the strongest force, in units of the drawing
FELT_SHARE = 1.1  # of the longest arrow: a longer measured force is cut, so that one impact does not dwarf the rest
EDGE = 22.0
AIR = 80.0  # round the body
TALLEST = 1.1  # of the width
LARGE = 0.5  # of the window: an obstacle that reaches further, a wall, is cut at the edge
GROWN_AT_MOST = 4
FOOT = 30.0  # under the drawing, for the scales


@dataclass(frozen=True)
class View:
    """One scale for length and one for force, shared by all instants of a report."""

    low_w: Floats  # (2,), m: the corner that is drawn at left and bottom, in the turned frame
    scale: float  # units per metre
    force_scale: float  # units per newton
    width: float
    height: float
    upright: bool  # the snake lies along y: the ground is turned by a quarter

    def turned(self, vectors_w: Floats) -> Floats:
        """World vectors (..., 2) in the frame of the drawing, y still up."""
        return np.stack([vectors_w[..., 1], -vectors_w[..., 0]], axis=-1) if self.upright else vectors_w

    def at(self, point_w: Floats | tuple[float, ...]) -> Point:
        """Where a point of the ground is drawn."""
        x, y = (self.turned(np.asarray(point_w, dtype=np.float64)[:2]) - self.low_w) * self.scale
        return float(x), float(self.height - FOOT - y)

    def along(self, start: Point, vector_w: Floats | tuple[float, ...], units: float) -> Point:
        """`start` moved by `units` times a world vector."""
        x, y = self.turned(np.asarray(vector_w, dtype=np.float64)[:2])
        return float(start[0] + units * x), float(start[1] - units * y)

    def shows(self, obstacle: Obstacle) -> bool:
        """Whether an obstacle is drawn: as a whole, unless it is too large for that."""
        (x, y), reach = self.at(obstacle.position_w), self.scale * reach_m(obstacle)
        across, tall = self.width, self.height - FOOT
        if reach > LARGE * min(across, tall):
            return -reach < x < across + reach and -reach < y < tall + reach
        return reach <= x <= across - reach and reach <= y <= tall - reach


def reach_m(obstacle: Obstacle) -> float:
    """How far an obstacle reaches from its middle, on the ground."""
    return max(obstacle.radius_m, math.hypot(*obstacle.half_size_m[:2]))


def views(record: RunRecord, instants: list[Instant], width: float) -> list[View]:
    """A window for each instant, all of one size and at one scale: round the body, with room for the arrows."""
    bodies = [nodes_xy_w(record, one.row) for one in instants]
    balances = [one.balance for one in instants if one.balance is not None]
    sizes = [size for one in balances for size in (*one.size_n, float(np.hypot(*one.resultant_n)))]
    sizes = sizes or [math.hypot(*contact.force_w[:2]) for one in instants for contact in one.felt]
    units_per_n = LONGEST_ARROW / max(sizes) if sizes and max(sizes) > 0 else 0.0
    return _windows(record, bodies, units_per_n, width) if bodies else []


def map_view(record: RunRecord, nodes: list[Floats], units_per_n: float, width: float) -> View:
    """One window for a whole run. nodes: the body at some of its instants, (k, 2) each."""
    return _windows(record, [np.vstack(nodes)], units_per_n, width)[0]


def _windows(record: RunRecord, shown: list[Floats], units_per_n: float, width: float) -> list[View]:
    """One for each of some sets of points, (k, 2)."""
    spans = np.ptp(shown[0], axis=0)
    upright = bool(spans[1] > 1.3 * spans[0])
    plain = View(np.zeros(2), 1.0, units_per_n, 0.0, 0.0, upright)
    turned = [plain.turned(points) for points in shown]
    air_m = AIR * max(float(np.ptp(points[:, 0])) for points in turned) / (width - 2 * AIR)
    boxes = [_with_obstacles(record, plain, p.min(axis=0) - air_m, p.max(axis=0) + air_m) for p in turned]
    across, tall = np.max([high - low for low, high in boxes], axis=0)
    scale = width / float(across)
    height = min(float(tall) * scale, TALLEST * width)
    half = np.array([width, height]) / (2 * scale)
    return [View((low + high) / 2 - half, scale, units_per_n, width, height + FOOT, upright) for low, high in boxes]


def _with_obstacles(record: RunRecord, plain: View, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """A window that is grown until it cuts no obstacle but large ones."""
    found = [item.obstacle for item in record.placed]
    large = LARGE * float((high - low).min())
    small = [(plain.turned(np.array(one.position_w[:2])), 1.1 * reach_m(one)) for one in found if reach_m(one) <= large]
    for _ in range(GROWN_AT_MOST):
        cut = [(at, r) for at, r in small if (at + r > low).all() and (at - r < high).all()]
        low = np.min([low, *(at - r for at, r in cut)], axis=0)
        high = np.max([high, *(at + r for at, r in cut)], axis=0)
    return low, high


def nodes_xy_w(record: RunRecord, row: int) -> Floats:
    """Tail end, joints and head end on the ground, (joints + 2, 2)."""
    nodes = record.nodes_w(row)
    assert nodes is not None, "rows without a pose are not drawn"
    return nodes[:, :2]
