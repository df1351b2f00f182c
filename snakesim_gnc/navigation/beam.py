"""The search for a path ahead of the head: layers of short arcs, all expanded at once, the best few kept. Pure.

A search is a generator, with the path as its return value. It yields what its next step costs, in nodes to expand,
before it does it: so whoever drives it decides how much is done when, and the path does not depend on that.

Each node knows what the whole body would touch with its head there: the last contacts as wrenches, and the integral of
the drag's wrench, first along the measured body and then along the path. So every node has the propulsion margin of the
body. Cost, per metre of path:

    1 - reward n.g of a touch that pushes towards the goal, + harm |n.g| of one that pushes back
      + weak max(0, 1 - F*/F_wanted) + bend |change of curvature| - progress along the goal's direction g
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.planar import wrenches
from snakesim_gnc.navigation.line import back_from_end
from snakesim_gnc.navigation.margin import margins_n
from snakesim_gnc.navigation.obstacle_map import NONE, ROUGH_M, ObstacleMap
from snakesim_hal.arrays import Floats

Ints = NDArray[np.intp]

STEP_M = 0.05
CONTACTS = 8  # of a body that are remembered, the newest
CELL_M, CELL_RAD = 0.02, np.pi / 18
WIDE_CELL_M, WIDE_CELL_RAD = 0.1, 0.6
MIN_PUSH = -0.1  # n.g of a touch that counts for the margin: `snap` takes the body away from those that brake more
FAILED_M = 0.025  # a path this far from one that failed is another path
ALONG = 0.35  # |n.t| of a touch: beyond, it is the head that bumps


@dataclass(frozen=True)
class Search:
    """What to look for; lengths in metres."""

    body_length_m: float
    radius_m: float
    segment_m: float  # length of a link: straight links cut the corners of the path by segment^2 |curvature| / 8
    clearance_m: float = 0.004
    skin_m: float = 0.02  # nearer than this to an obstacle counts as a touch: `snap` will close the gap
    width: int = 900
    crowd: int = 16  # nodes that may stay in one wide cell: so other ways round stay in the search
    curvatures_per_m: tuple[float, ...] = (-5.5, -3.7, -1.8, 0.0, 1.8, 3.7, 5.5)
    wanted_n: float = 40.0  # F_wanted
    reward: float = 2.4
    harm: float = 1.0
    weak: float = 6.0
    bend_m: float = 0.02
    progress: float = 1.2
    grip: float = 4.0  # reward of a touch while the whole body is laid again
    weak_now: float = 15.0  # instead of `weak`, over the first `now_m` from where the body lies
    now_m: float = 0.3
    repeat: float = 1.0  # of a path that has failed
    move: float = 0.5  # of the body, sideways, as far as it may
    peg_friction: float = 0.0
    loose_tail_m: float = 0.2  # touches this near to the ends of the body do not count for its margin
    loose_head_m: float = 0.1


@dataclass
class Layer:
    """Nodes of one depth; arrays with one row a node."""

    x: Floats
    y: Floats
    heading: Floats
    bend: Floats  # curvature of the arc that led here
    cost: Floats
    parent: Ints
    touched: Ints  # (n, CONTACTS) obstacle, NONE: empty slot; the newest last
    touch_s: Floats  # (n, CONTACTS) arc length of the touch
    touch_gap: Floats
    push: Floats  # (n, CONTACTS, 3) wrench of a unit push
    drag: Floats  # (n, 3) wrench of the tangent, over the whole body
    arc: Floats  # (n, 3) of that, over the arc that led here
    margin_n: Floats
    s_m: float

    def take(self, rows: Ints) -> "Layer":
        """Some of the nodes."""
        arrays = {name: values[rows] for name, values in vars(self).items() if name != "s_m"}
        return Layer(**arrays, s_m=self.s_m)


@dataclass(frozen=True)
class PlannedPath:
    """A path ahead of the head."""

    points_w: Floats  # (n + 1, 2) every STEP_M, the first is the head
    headings_rad: Floats  # (n + 1,)
    bends_per_m: Floats  # (n,)
    margins_n: Floats  # (n + 1,) of the body with its head there
    cost: float


PathSearch = Generator[int, None, PlannedPath | None]  # nodes of each step; returns the path, or None: there is none


class Beam:
    """Searches from a body's head towards a direction."""

    def __init__(self, obstacles: ObstacleMap, search: Search) -> None:
        self._map = obstacles
        self._set = search
        self._bends = np.array(search.curvatures_per_m)
        self._arcs = round(search.body_length_m / STEP_M)
        half = 0.5 * self._bends * STEP_M
        chord = STEP_M * np.sinc(half / np.pi)
        chord_mid = 0.5 * STEP_M * np.sinc(0.5 * half / np.pi)
        self._end = np.stack([chord * np.cos(half), chord * np.sin(half)])
        self._middle = np.stack([chord_mid * np.cos(0.5 * half), chord_mid * np.sin(0.5 * half)])

    def ahead(self, body_w: Floats, goal_rad: float, steps: int) -> PathSearch:
        """The best path of a number of steps ahead of the head, or of as many as there is room for; None: none at all.

        body_w: (n, 2) the body's curve, tail to head.
        """
        self._aim(body_w[-1], goal_rad)
        self._corridor = None
        start = self._lying(body_w)
        return (yield from self._grow(start, steps))

    def whole(
        self, body_w: Floats, goal_rad: float, steps: int, reach_m: float, failed_w: Floats | None = None
    ) -> PathSearch:
        """The best path of the whole body, from the tail, and of a number of steps beyond: within reach of the body.

        failed_w: (k, 2) points of paths on which the body got stuck here; other ways round are preferred.
        """
        self._aim(body_w[-1], goal_rad)
        self._corridor, self._reach_m, self._failed = back_from_end(body_w, STEP_M, self._arcs), reach_m, failed_w
        self._first_arcs = np.zeros((self._arcs, 3))
        return (yield from self._grow(self._at_tail(), self._arcs + steps))

    def _aim(self, origin: Floats, goal_rad: float) -> None:
        self._origin = origin
        self._goal = np.array([np.cos(goal_rad), np.sin(goal_rad)])
        self._goal_rad = goal_rad

    def _grow(self, start: Layer, steps: int) -> PathSearch:
        layers = [start]
        for _ in range(steps):
            yield len(layers[-1].x)
            after = self._expand(layers)
            if after is None:
                break
            layers.append(after)
        if len(layers) == 1:
            return None
        return self._trace(layers)

    def _lying(self, body_w: Floats) -> Layer:
        """The node of the body as it lies, with what it touches."""
        at = back_from_end(body_w, STEP_M, self._arcs)
        chords = np.diff(at, axis=0)
        tangents = chords / np.maximum(np.hypot(*chords.T), 1e-9)[:, None]
        middles = 0.5 * (at[1:] + at[:-1])
        node = self._blank(body_w[-1:], np.arctan2(*(body_w[-1:] - body_w[-2:-1]).T[::-1]))
        self._first_arcs = STEP_M * wrenches(middles - self._origin, tangents)
        node.drag = self._first_arcs.sum(axis=0)[None]
        for k in range(self._arcs):
            self._touch(node, middles[None, k], tangents[None, k], -STEP_M * (self._arcs - k - 0.5))
        node.margin_n = self._margins(node)
        return node

    def _at_tail(self) -> Layer:
        """Nodes around the tail end, of bodies that begin there."""
        assert self._corridor is not None
        tail, along = self._corridor[0], self._corridor[1] - self._corridor[0]
        heading = float(np.arctan2(along[1], along[0]))
        left = np.array([-np.sin(heading), np.cos(heading)])
        places = np.concatenate([np.tile(tail + off * left, (5, 1)) for off in (-0.03, 0.0, 0.03)])
        return self._blank(places, np.tile(heading + np.array([-0.4, -0.2, 0.0, 0.2, 0.4]), 3))

    def _blank(self, places_w: Floats, headings: Floats) -> Layer:
        count = len(places_w)
        return Layer(
            x=places_w[:, 0].copy(),
            y=places_w[:, 1].copy(),
            heading=headings,
            bend=np.zeros(count),
            cost=np.zeros(count),
            parent=np.full(count, NONE),
            touched=np.full((count, CONTACTS), NONE),
            touch_s=np.full((count, CONTACTS), -np.inf),
            touch_gap=np.full((count, CONTACTS), np.inf),
            push=np.zeros((count, CONTACTS, 3)),
            drag=np.zeros((count, 3)),
            arc=np.zeros((count, 3)),
            margin_n=np.zeros(count),
            s_m=0.0,
        )

    def _touch(self, nodes: Layer, points_w: Floats, tangents: Floats, s_m: float) -> Floats:
        """Remember what the body touches at a point; returns the push towards the goal, n.g, or 0 without a touch."""
        near = self._map.near(points_w[:, 0], points_w[:, 1])
        gap = near.distance_m - self._set.radius_m
        along = np.abs(np.einsum("ij,ij->i", near.normal_w, tangents))
        beside = (near.obstacle != NONE) & (gap < self._set.skin_m) & (along < ALONG)
        towards = near.normal_w @ self._goal
        touches = beside & (towards > MIN_PUSH)
        places = points_w - near.normal_w * self._set.radius_m - self._origin
        direction = near.normal_w - self._set.peg_friction * tangents
        push = wrenches(places, direction)
        again = touches & (nodes.touched[:, -1] == near.obstacle)
        better = again & (gap < nodes.touch_gap[:, -1])
        new = touches & ~again
        for name, fresh in (("touched", near.obstacle), ("touch_gap", gap), ("push", push), ("touch_s", s_m)):
            slots = getattr(nodes, name)
            fresh_rows = fresh if isinstance(fresh, np.ndarray) else np.full(len(gap), fresh)
            slots[new, :-1] = slots[new, 1:]
            if name == "touch_s":
                slots[touches, -1] = fresh_rows[touches]
            else:
                slots[new | better, -1] = fresh_rows[new | better]
        return np.where(beside, towards, 0.0)

    def _margins(self, nodes: Layer) -> Floats:
        tail_s = nodes.s_m - self._set.body_length_m + self._set.loose_tail_m
        alive = (nodes.touch_s >= tail_s) & (nodes.touch_s <= nodes.s_m - self._set.loose_head_m)
        contacts = np.where(alive[..., None], nodes.push, 0.0)
        return margins_n(contacts, nodes.drag / self._set.body_length_m)

    def _left_behind(self, layers: Sequence[Layer], parents: Ints) -> Floats:
        """Drag over the arc that the tail leaves when these nodes of the newest layer get children."""
        if len(layers) <= self._arcs:
            return self._first_arcs[len(layers) - 1]
        rows = parents
        for older in reversed(layers[len(layers) - self._arcs + 1 :]):
            rows = older.parent[rows]
        return layers[-self._arcs].arc[rows]

    def _expand(self, layers: Sequence[Layer]) -> Layer | None:
        """All children of the newest layer that do not collide, thinned out, with their cost."""
        layer, config, count = layers[-1], self._set, len(self._bends)
        c, s = np.cos(layer.heading)[:, None], np.sin(layer.heading)[:, None]
        x0, y0 = layer.x[:, None], layer.y[:, None]
        xm, ym = x0 + c * self._middle[0] - s * self._middle[1], y0 + s * self._middle[0] + c * self._middle[1]
        x1, y1 = x0 + c * self._end[0] - s * self._end[1], y0 + s * self._end[0] + c * self._end[1]
        heading = layer.heading[:, None] + self._bends * STEP_M
        free = self._fits(xm, ym, heading - 0.5 * self._bends * STEP_M) & self._fits(x1, y1, heading)
        off = np.abs(np.remainder(heading - self._goal_rad + np.pi, 2 * np.pi) - np.pi)
        free &= off < 1.75
        lies = self._corridor
        away = None
        if lies is not None and (k := round(layer.s_m / STEP_M) + 1) < len(lies):
            away = np.hypot(x1 - lies[k, 0], y1 - lies[k, 1])
            free &= away < self._reach_m
        bend_change = np.abs(self._bends - layer.bend[:, None])
        progress = (x1 - x0) * self._goal[0] + (y1 - y0) * self._goal[1]
        cost = layer.cost[:, None] + STEP_M + config.bend_m * STEP_M * bend_change - config.progress * progress
        if away is not None and self._failed is not None:
            gaps = np.hypot(x1[..., None] - self._failed[:, 0], y1[..., None] - self._failed[:, 1]).min(axis=-1)
            cost = cost + STEP_M * config.repeat * np.maximum(1.0 - gaps / FAILED_M, 0.0)
        if away is not None:
            cost = cost + STEP_M * config.move * (away / self._reach_m) ** 2
        rows = np.flatnonzero(free.ravel())
        if not len(rows):
            return None
        rows = rows[np.argsort(cost.ravel()[rows], kind="stable")]
        cells = _cells(x1.ravel()[rows], y1.ravel()[rows], heading.ravel()[rows], CELL_M, CELL_RAD)
        rows = rows[np.sort(np.unique(cells, return_index=True)[1])[: 3 * config.width]]  # the cheapest of each cell
        parents = rows // count
        nodes = layer.take(parents)
        nodes.parent = parents
        nodes.x, nodes.y, nodes.heading = x1.ravel()[rows], y1.ravel()[rows], heading.ravel()[rows]
        nodes.bend, nodes.cost = self._bends[rows % count], cost.ravel()[rows]
        nodes.s_m = layer.s_m + STEP_M
        middle = np.stack([xm.ravel()[rows], ym.ravel()[rows]], axis=-1)
        at = nodes.heading - 0.5 * nodes.bend * STEP_M
        tangents = np.stack([np.cos(at), np.sin(at)], axis=-1)
        pushes = self._touch(nodes, middle, tangents, nodes.s_m - 0.5 * STEP_M)
        lying = lies is not None and nodes.s_m < config.body_length_m - 0.5 * STEP_M
        reward = config.grip if lying else config.reward
        nodes.cost += STEP_M * np.where(pushes > 0, -reward * pushes, -config.harm * pushes)
        nodes.arc = STEP_M * wrenches(middle - self._origin, tangents)
        nodes.drag += nodes.arc - self._left_behind(layers, parents)
        nodes.margin_n = self._margins(nodes)
        if not lying:
            weak = np.clip(1.0 - nodes.margin_n / config.wanted_n, 0.0, 1.0)
            now = lies is not None and nodes.s_m < config.body_length_m + config.now_m
            nodes.cost += STEP_M * (config.weak_now if now else config.weak) * weak
        order = np.argsort(nodes.cost, kind="stable")
        places = _cells(nodes.x[order], nodes.y[order], nodes.heading[order], WIDE_CELL_M, WIDE_CELL_RAD)
        return nodes.take(order[_rank(places) < config.crowd][: config.width])

    def _fits(self, x: Floats, y: Floats, heading: Floats) -> NDArray[np.bool_]:
        """Whether the body clears everything; x, y, heading: (n, curvatures)."""
        cuts, clear_m = self._set.segment_m**2 * np.abs(self._bends) / 8, self._set.radius_m + self._set.clearance_m
        rough_m = self._map.roughly_m(x, y)
        fits = rough_m >= clear_m + cuts + ROUGH_M
        unsure = np.nonzero(~fits & (rough_m >= clear_m - ROUGH_M))
        near = self._map.near(x[unsure], y[unsure])
        at, curve = heading[unsure], unsure[1]
        left = np.cos(at) * near.normal_w[:, 1] - np.sin(at) * near.normal_w[:, 0]
        inner = left * np.sign(self._bends[curve]) < 0  # the obstacle is on the side towards which the path bends
        fits[unsure] = near.distance_m >= clear_m + np.where(inner, cuts[curve], 0.0)
        return fits

    def _trace(self, layers: list[Layer]) -> PlannedPath:
        row = int(np.argmin(layers[-1].cost))
        cost = float(layers[-1].cost[row])
        rows: list[int] = []
        for layer in reversed(layers):
            rows.append(row)
            row = int(layer.parent[row])
        picked = zip(layers, reversed(rows), strict=True)
        x, y, heading, bend, margin = np.array(
            [(n.x[r], n.y[r], n.heading[r], n.bend[r], n.margin_n[r]) for n, r in picked]
        ).T
        return PlannedPath(np.stack([x, y], axis=-1), heading, bend[1:], margin, cost)


def _cells(x: Floats, y: Floats, heading: Floats, size_m: float, size_rad: float) -> NDArray[np.int64]:
    """A number for each cell of place and heading."""
    a = np.floor(x / size_m).astype(np.int64)
    b = np.floor(y / size_m).astype(np.int64)
    c = np.floor(heading / size_rad).astype(np.int64)
    return (a * 100_003 + b) * 1009 + c


def _rank(cells: NDArray[np.int64]) -> Ints:
    """How many of the same cell come before each, (n,)."""
    order = np.argsort(cells, kind="stable")
    first = np.concatenate(([True], np.diff(cells[order]) != 0))
    starts = np.flatnonzero(first)
    rank = np.empty(len(order), dtype=np.intp)
    rank[order] = np.arange(len(order)) - starts[np.cumsum(first) - 1]
    return rank
