"""How the ground is laid on a drawing: which window, at what scale, and how long a force is drawn."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.scenario import place_all
from snakesim_hal.wire.messages import Obstacle
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import Instant
from snakesim_operator.results.report.svg import Point

Floats = NDArray[np.float64]
LONGEST_ARROW = 92.0  # of the strongest force, in units of the drawing
FELT_SHARE = 1.4  # of the longest arrow: a longer measured force is cut, so that one impact does not dwarf the rest
EDGE = 22.0
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
    longest: float  # arrow of the strongest solved force

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


def map_view(record: RunRecord, nodes: list[Floats], width: float) -> View:
    """One window for a whole run. nodes: the body at some of its instants, (k, 2) each."""
    everything = np.vstack(nodes)
    upright = bool(np.ptp(everything[:, 1]) > 1.3 * np.ptp(everything[:, 0]))
    plain = View(np.zeros(2), 1.0, 0.0, 0.0, 0.0, upright, LONGEST_ARROW)
    radius = 3 * max(link.radius_m for link in record.description.links)
    reached = plain.turned(everything)
    low, high = _with_obstacles(record, plain, reached.min(axis=0) - radius, reached.max(axis=0) + radius)
    scale = width / float(high[0] - low[0])
    height = min(float(high[1] - low[1]) * scale, 0.8 * width)
    if height < float(high[1] - low[1]) * scale:
        scale = height / float(high[1] - low[1])
    corner = (low + high) / 2 - np.array([width, height]) / (2 * scale)
    return View(corner, scale, 0.0, width, height + FOOT, upright, LONGEST_ARROW)


def _with_obstacles(record: RunRecord, plain: View, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """A window that is grown until it cuts no obstacle but large ones."""
    found = [item.obstacle for item in place_all(record.config)]
    large = LARGE * float((high - low).min())
    small = [(plain.turned(np.array(one.position_w[:2])), 1.1 * reach_m(one)) for one in found if reach_m(one) <= large]
    for _ in range(GROWN_AT_MOST):
        cut = [(at, r) for at, r in small if (at + r > low).all() and (at - r < high).all()]
        if not cut:
            break
        grown = np.min([low, *(at - r for at, r in cut)], axis=0), np.max([high, *(at + r for at, r in cut)], axis=0)
        if np.array_equal(grown, (low, high)):
            break
        low, high = grown
    return low, high


def nodes_xy_w(record: RunRecord, instant: Instant) -> Floats:
    """Tail end, joints and head end on the ground, (joints + 2, 2)."""
    nodes = record.nodes_w(instant.row)
    assert nodes is not None, "instants without a pose are not chosen"
    return nodes[:, :2]


def views(record: RunRecord, instants: list[Instant], width: float, longest: float = LONGEST_ARROW) -> list[View]:
    """A view for each instant: one window for all when the snake stays within it, else one that goes along."""
    if not instants:
        return []
    bodies = [nodes_xy_w(record, one) for one in instants]
    ends = bodies[0][-1] - bodies[0][0]
    upright = bool(abs(ends[1]) > 1.3 * abs(ends[0]))
    plain = View(np.zeros(2), 1.0, _force_scale(instants, longest), 0.0, 0.0, upright, longest)
    body_m = max(float(np.ptp(plain.turned(body), axis=0)[0]) for body in bodies)
    across, tall = body_m, 0.0  # how far the arrows reach depends on the scale, and the scale on how far they reach
    lows = highs = np.zeros((len(instants), 2))
    for _ in range(GROWN_AT_MOST):
        metres_per_unit = across / (width - 2 * EDGE)
        reached = [plain.turned(_reached_w(record, one, plain.force_scale * metres_per_unit)) for one in instants]
        air = EDGE * metres_per_unit
        boxes = [_with_obstacles(record, plain, r.min(axis=0) - air, r.max(axis=0) + air) for r in reached]
        lows, highs = np.array([low for low, _ in boxes]), np.array([high for _, high in boxes])
        across, tall = (highs - lows).max(axis=0)
        union = highs.max(axis=0) - lows.min(axis=0)
        if union[0] < 1.5 * across:  # one window holds them all
            across, tall = union
            lows[:], highs[:] = lows.min(axis=0), highs.max(axis=0)
    scale = width / float(across)
    height = min(float(tall) * scale, 1.1 * width) + FOOT
    corners = (lows + highs) / 2 - np.array([width, height - FOOT]) / (2 * scale)
    return [View(corner, scale, plain.force_scale, width, height, upright, longest) for corner in corners]


def _force_scale(instants: list[Instant], longest: float) -> float:
    solved = [0.0]
    for one in instants:
        if one.balance is not None:
            solved += [*one.balance.size_n, float(np.hypot(*one.balance.resultant_n))]
    strongest = max(solved) or max((math.hypot(*c.force_w[:2]) for one in instants for c in one.felt), default=0.0)
    return longest / strongest if strongest > 0 else 0.0


def _reached_w(record: RunRecord, instant: Instant, metres_per_n: float) -> Floats:
    """Points on the ground, (k, 2), that the drawing of an instant must hold: the body, pegs pushed at, arrow tips."""
    nodes = nodes_xy_w(record, instant)
    radius = max(link.radius_m for link in record.description.links)
    points: list[Floats] = [nodes - radius, nodes + radius]
    pushes = [(contact, np.array(contact.force_w[:2])) for contact in instant.felt]
    if instant.balance is not None:
        pushes += list(zip(instant.balance.contacts, instant.balance.contact_n, strict=True))
        start = np.array(instant.balance.contacts[0].position_w[:2])
        points.append((start + metres_per_n * instant.balance.resultant_n)[None])
    longest = FELT_SHARE * _longest_n(instant)
    for contact, force in pushes:
        at, normal = np.array(contact.position_w[:2]), np.array(contact.normal_w[:2])
        cut = min(1.0, longest / max(float(np.hypot(*force)), 1e-9))
        points += [(at - 0.05 * normal)[None], (at + cut * metres_per_n * force)[None]]
    return np.vstack(points)


def _longest_n(instant: Instant) -> float:
    if instant.balance is not None:
        return max(*instant.balance.size_n, float(np.hypot(*instant.balance.resultant_n)))
    return max((math.hypot(*c.force_w[:2]) for c in instant.felt), default=0.0)
