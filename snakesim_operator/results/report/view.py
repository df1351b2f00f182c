"""How the ground is laid on a drawing: which window, at what scale, and how long a force is drawn."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import Instant
from snakesim_operator.results.report.svg import Point

Floats = NDArray[np.float64]
LONGEST_ARROW = 92.0  # of the strongest force, in units of the drawing
FELT_SHARE = 1.4  # of the longest arrow: a longer measured force is cut, so that one impact does not dwarf the rest
EDGE = 22.0
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
    metres_per_unit = body_m / (width - 2 * EDGE)  # near enough to find out how far the arrows reach
    reached = [plain.turned(_reached_w(record, one, plain.force_scale * metres_per_unit)) for one in instants]
    lows, highs = np.array([r.min(axis=0) for r in reached]), np.array([r.max(axis=0) for r in reached])
    across, tall = (highs - lows).max(axis=0)
    union = highs.max(axis=0) - lows.min(axis=0)
    fixed = bool(union[0] < 1.5 * across)
    if fixed:
        across, tall = union
        lows, highs = np.broadcast_to(lows.min(axis=0), lows.shape), np.broadcast_to(highs.max(axis=0), highs.shape)
    scale = (width - 2 * EDGE) / float(across)
    height = min(float(tall) * scale + 2 * EDGE, 1.1 * width) + FOOT
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
