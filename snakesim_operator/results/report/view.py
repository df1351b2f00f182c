"""How the ground is laid on a drawing: which window, at what scale, and how long a force is drawn."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Obstacle
from snakesim_operator.results.page.svg import Point
from snakesim_operator.results.report.snapshots import Snapshot
from snakesim_operator.results.run_log import RunRecord

LONGEST_ARROW = 72.0  # of the strongest force, in units of the drawing
FELT_SHARE = 1.1  # of the longest arrow: a longer measured force is cut, so that one impact does not dwarf the rest
EDGE = 22.0
AIR = 80.0  # round the body
TALLEST = 1.1  # of the width
LARGE = 0.5  # of the window: an obstacle that reaches further, a wall, is cut at the edge
MAX_GROWTH_STEPS = 4  # of a window around the obstacles that it cuts
FOOT = 30.0  # under the drawing, for the scales


@dataclass(frozen=True)
class View:
    """One scale for length and one for force, shared by all snapshots of a report."""

    low_w: Floats  # (2,), m: the corner that is drawn at left and bottom, in the turned frame
    scale: float  # units per meter
    force_scale: float  # units per newton
    width: float
    height: float
    upright: bool  # the snake lies along y: the ground is turned by a quarter

    def rotate(self, vectors_w: Floats) -> Floats:
        """Rotate world vectors (..., 2) into the frame of the drawing, with y still up."""
        if not self.upright:
            return vectors_w
        return np.stack([vectors_w[..., 1], -vectors_w[..., 0]], axis=-1)

    def at(self, point_w: Floats | tuple[float, ...]) -> Point:
        """Return the place in the drawing of a point of the ground."""
        x, y = (self.rotate(np.asarray(point_w, dtype=np.float64)[:2]) - self.low_w) * self.scale
        return float(x), float(self.height - FOOT - y)

    def along(self, start: Point, vector_w: Floats | tuple[float, ...], units: float) -> Point:
        """Return `start` moved by `units` times a world vector."""
        x, y = self.rotate(np.asarray(vector_w, dtype=np.float64)[:2])
        return float(start[0] + units * x), float(start[1] - units * y)

    def shows(self, obstacle: Obstacle) -> bool:
        """Return whether an obstacle is drawn: only if it fits as a whole, unless it is too large for that."""
        x, y = self.at(obstacle.position_w)
        reach = self.scale * reach_m(obstacle)
        map_width = self.width
        map_height = self.height - FOOT
        if reach > LARGE * min(map_width, map_height):
            return -reach < x < map_width + reach and -reach < y < map_height + reach
        return reach <= x <= map_width - reach and reach <= y <= map_height - reach


def reach_m(obstacle: Obstacle) -> float:
    """Return how far an obstacle extends from its middle, on the ground."""
    return max(obstacle.radius_m, math.hypot(*obstacle.half_size_m[:2]))


def views(record: RunRecord, snapshots: list[Snapshot], width: float) -> list[View]:
    """Return a window for each snapshot, all of one size and one scale: around the body, with room for the arrows."""
    if not snapshots:
        return []
    bodies = [nodes_xy_w(record, snapshot.row) for snapshot in snapshots]
    max_force_n = _max_force_n(snapshots)
    units_per_n = LONGEST_ARROW / max_force_n if max_force_n > 0 else 0.0
    return _windows(record, bodies, units_per_n, width)


def _max_force_n(snapshots: list[Snapshot]) -> float:
    """Return the largest solved force; without any, the largest measured one."""
    solved_n: list[float] = []
    measured_n: list[float] = []
    for snapshot in snapshots:
        if snapshot.balance is not None:
            solved_n += [*snapshot.balance.size_n, float(np.hypot(*snapshot.balance.resultant_n))]
        measured_n += [math.hypot(*contact.force_w[:2]) for contact in snapshot.measured_contacts]
    return max(solved_n or measured_n, default=0.0)


def map_view(record: RunRecord, nodes: list[Floats], units_per_n: float, width: float) -> View:
    """Return one window for a whole run. nodes: the body at some of its times, (k, 2) each."""
    return _windows(record, [np.vstack(nodes)], units_per_n, width)[0]


def _windows(record: RunRecord, point_sets: list[Floats], units_per_n: float, width: float) -> list[View]:
    """Return a window of the ground around each set of points, all of one size and one scale.

    If the first set is taller than wide, the ground is rotated by a quarter turn. A window grows so that it does not
    cut obstacles.

    Args:
        record: The recorded run, with its obstacles.
        point_sets: Points in the world to show, (k, 2) in m.
        units_per_n: Scale of force, in units of the drawing per newton.
        width: Width of the drawings.
    """
    span_x, span_y = np.ptp(point_sets[0], axis=0)
    upright = bool(span_y > 1.3 * span_x)
    unscaled = View(np.zeros(2), 1.0, units_per_n, 0.0, 0.0, upright)
    rotated_sets = [unscaled.rotate(points) for points in point_sets]
    max_span_m = max(float(np.ptp(points[:, 0])) for points in rotated_sets)
    margin_m = AIR * max_span_m / (width - 2 * AIR)

    boxes: list[tuple[Floats, Floats]] = []
    for points in rotated_sets:
        low = points.min(axis=0) - margin_m
        high = points.max(axis=0) + margin_m
        boxes.append(_grow_around_obstacles(record, unscaled, low, high))

    # The largest window sets the scale of all.
    width_m, height_m = np.max([high - low for low, high in boxes], axis=0)
    scale = width / float(width_m)
    height = min(float(height_m) * scale, TALLEST * width)
    half_size_m = np.array([width, height]) / (2 * scale)
    windows: list[View] = []
    for low, high in boxes:
        corner = (low + high) / 2 - half_size_m
        windows.append(View(corner, scale, units_per_n, width, height + FOOT, upright))
    return windows


def _grow_around_obstacles(record: RunRecord, unscaled: View, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Grow a window until it cuts no obstacle except large ones. low, high: its corners."""
    max_reach_m = LARGE * float((high - low).min())
    small: list[tuple[Floats, float]] = []
    for item in record.placed:
        obstacle_reach_m = reach_m(item.obstacle)
        if obstacle_reach_m <= max_reach_m:
            small.append((unscaled.rotate(np.array(item.obstacle.position_w[:2])), 1.1 * obstacle_reach_m))
    for _ in range(MAX_GROWTH_STEPS):
        cut = [(at, reach) for at, reach in small if (at + reach > low).all() and (at - reach < high).all()]
        low = np.min([low, *(at - reach for at, reach in cut)], axis=0)
        high = np.max([high, *(at + reach for at, reach in cut)], axis=0)
    return low, high


def nodes_xy_w(record: RunRecord, row: int) -> Floats:
    """Return tail end, joints and head end on the ground, (joints + 2, 2)."""
    nodes = record.nodes_w(row)
    assert nodes is not None, "rows without a pose are not drawn"
    return nodes[:, :2]
