"""The search for a path ahead of the head: layers of short arcs, all expanded at once, the best few kept. Pure.

A search is a generator, with the path as its return value. It yields what its next step costs, in nodes to expand,
before it does it: so whoever drives it decides how much is done when, and the path does not depend on that.

Each node knows what the whole body would touch with its head there: the last contacts as wrenches, and the integral of
the drag's wrench, first along the measured body and then along the path. So every node has the propulsion margin of the
body. Cost, per metre of path:

    1 - push_reward n.g of a touch that pushes towards the goal, + brake_cost |n.g| of one that pushes back
      + weak_cost max(0, 1 - F*/F_wanted) + bend_m |change of curvature| - progress_reward of the way along the goal g

n: unit normal of a touch, from the obstacle to the body; t: unit tangent of the body; g: unit vector to the goal; F*:
the propulsion margin in N. In shapes, n is the number of nodes, and c that of the curvatures that a child may have. All
points and headings are of the world.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import wrenches
from snakesim_gnc.navigation.line import back_from_end
from snakesim_gnc.navigation.margin import margins_n
from snakesim_gnc.navigation.obstacle_map import NONE, ROUGH_M, ObstacleMap
from snakesim_hal.base.arrays import Floats

Ints = NDArray[np.intp]

STEP_M = 0.05
CONTACTS = 8  # of a body that are remembered, the newest
CELL_M, CELL_RAD = 0.02, np.pi / 18
WIDE_CELL_M, WIDE_CELL_RAD = 0.1, 0.6
MIN_TOWARDS = -0.1  # n.g of a touch that counts for the margin: `snap` takes the body away from those that brake more
FAILED_M = 0.025  # a path this far from one that failed is another path
MAX_FRONTAL = 0.35  # |n.t| of a touch: beyond, it is the head that bumps


@dataclass(frozen=True)
class Search:
    """What to look for; costs and rewards are in metres of path for each metre of path."""

    body_length_m: float
    radius_m: float
    segment_m: float  # length of a link: straight links cut the corners of the path by segment^2 |curvature| / 8
    clearance_m: float = 0.004
    skin_m: float = 0.02  # nearer than this to an obstacle counts as a touch: `snap` will close the gap
    kept_nodes: int = 900
    kept_per_wide_cell: int = 16  # nodes that may stay in one wide cell: so other ways round stay in the search
    curvatures_per_m: tuple[float, ...] = (-5.5, -3.7, -1.8, 0.0, 1.8, 3.7, 5.5)
    wanted_margin_n: float = 40.0  # F_wanted, of the margin
    push_reward: float = 2.4
    brake_cost: float = 1.0
    weak_cost: float = 6.0
    bend_m: float = 0.02
    progress_reward: float = 1.2
    push_reward_lying: float = 4.0  # instead of `push_reward`, while the whole body is laid again
    weak_cost_ahead: float = 15.0  # instead of `weak_cost`, over the first `ahead_m` from where the body lies
    ahead_m: float = 0.3
    failed_path_cost: float = 1.0  # of a path within FAILED_M of one that has failed
    sideways_cost: float = 0.5  # of a body moved sideways as far as it may be
    peg_friction: float = 0.0
    loose_tail_m: float = 0.2  # touches this near to the ends of the body do not count for its margin
    loose_head_m: float = 0.1


@dataclass
class Layer:
    """Nodes of one depth; arrays with one row a node."""

    x_m: Floats  # (n,)
    y_m: Floats  # (n,)
    heading_rad: Floats  # (n,)
    bend_per_m: Floats  # (n,) curvature of the arc that led here
    cost_m: Floats  # (n,) of the path from the start, in metres of path
    parent: Ints  # (n,) row in the layer before
    touched: Ints  # (n, CONTACTS) obstacle, NONE: empty slot; the newest last
    touch_s_m: Floats  # (n, CONTACTS) arc length of the touch
    touch_gap_m: Floats  # (n, CONTACTS) between skin and obstacle
    push: Floats  # (n, CONTACTS, 3) wrench of a unit push: fx, fy, and the moment about the search's origin in m
    drag_m: Floats  # (n, 3) integral of the tangent's wrench over the whole body: m, m, m2
    arc_drag_m: Floats  # (n, 3) of that, over the arc that led here
    margin_n: Floats  # (n,)
    s_m: float  # arc length of these nodes, from the start

    def take(self, rows: Ints) -> "Layer":
        """Some of the nodes."""
        arrays = {name: values[rows] for name, values in vars(self).items() if name != "s_m"}
        return Layer(**arrays, s_m=self.s_m)


@dataclass(frozen=True)
class PlannedPath:
    """A path ahead of the head."""

    points_w: Floats  # (n + 1, 2) every STEP_M, the first is the head
    margins_n: Floats  # (n + 1,) of the body with its head there
    cost_m: float


PathSearch = Generator[int, None, PlannedPath | None]  # nodes of each step; returns the path, or None: there is none


class Beam:
    """Searches from a body's head towards a direction."""

    def __init__(self, obstacles: ObstacleMap, search: Search) -> None:
        self._map = obstacles
        self._set = search
        self._bends_per_m = np.array(search.curvatures_per_m)
        self._arcs = round(search.body_length_m / STEP_M)
        half = 0.5 * self._bends_per_m * STEP_M
        chord = STEP_M * np.sinc(half / np.pi)
        chord_mid = 0.5 * STEP_M * np.sinc(0.5 * half / np.pi)
        # (2, c): where a child's arc ends and where its middle is, ahead and to the left of its parent
        self._end_m = np.stack([chord * np.cos(half), chord * np.sin(half)])
        self._middle_m = np.stack([chord_mid * np.cos(0.5 * half), chord_mid * np.sin(0.5 * half)])

    def ahead(self, body_w: Floats, goal_rad: float, steps: int) -> PathSearch:
        """The best path of a number of steps ahead of the head, or of as many as there is room for; None: none at all.

        body_w: (n, 2) the body's curve, tail to head.
        """
        self._aim(body_w[-1], goal_rad)
        self._lies_w = None
        start = self._lying(body_w)
        return (yield from self._grow(start, steps))

    def whole(
        self, body_w: Floats, goal_rad: float, steps: int, reach_m: float, failed_w: Floats | None = None
    ) -> PathSearch:
        """The best path of the whole body, from the tail, and of a number of steps beyond: within reach of the body.

        failed_w: (k, 2) points of paths on which the body got stuck here; other ways round are preferred.
        """
        self._aim(body_w[-1], goal_rad)
        self._lies_w, self._reach_m, self._failed_w = back_from_end(body_w, STEP_M, self._arcs), reach_m, failed_w
        self._lying_drag_m = np.zeros((self._arcs, 3))
        return (yield from self._grow(self._at_tail(), self._arcs + steps))

    def _aim(self, origin: Floats, goal_rad: float) -> None:
        self._origin_w = origin
        self._goal_w = np.array([np.cos(goal_rad), np.sin(goal_rad)])
        self._goal_rad = goal_rad

    def _grow(self, start: Layer, steps: int) -> PathSearch:
        layers = [start]
        for _ in range(steps):
            yield len(layers[-1].x_m)
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
        self._lying_drag_m = STEP_M * wrenches(middles - self._origin_w, tangents)
        node.drag_m = self._lying_drag_m.sum(axis=0)[None]
        for k in range(self._arcs):
            self._touch(node, middles[None, k], tangents[None, k], -STEP_M * (self._arcs - k - 0.5))
        node.margin_n = self._margins(node)
        return node

    def _at_tail(self) -> Layer:
        """Nodes around the tail end, of bodies that begin there."""
        assert self._lies_w is not None
        tail, along = self._lies_w[0], self._lies_w[1] - self._lies_w[0]
        heading = float(np.arctan2(along[1], along[0]))
        left = np.array([-np.sin(heading), np.cos(heading)])
        places = np.concatenate([np.tile(tail + off * left, (5, 1)) for off in (-0.03, 0.0, 0.03)])
        return self._blank(places, np.tile(heading + np.array([-0.4, -0.2, 0.0, 0.2, 0.4]), 3))

    def _blank(self, places_w: Floats, headings: Floats) -> Layer:
        count = len(places_w)
        return Layer(
            x_m=places_w[:, 0].copy(),
            y_m=places_w[:, 1].copy(),
            heading_rad=headings,
            bend_per_m=np.zeros(count),
            cost_m=np.zeros(count),
            parent=np.full(count, NONE),
            touched=np.full((count, CONTACTS), NONE),
            touch_s_m=np.full((count, CONTACTS), -np.inf),
            touch_gap_m=np.full((count, CONTACTS), np.inf),
            push=np.zeros((count, CONTACTS, 3)),
            drag_m=np.zeros((count, 3)),
            arc_drag_m=np.zeros((count, 3)),
            margin_n=np.zeros(count),
            s_m=0.0,
        )

    def _touch(self, nodes: Layer, points_w: Floats, tangents: Floats, s_m: float) -> Floats:
        """Remember what the body touches; returns the push towards the goal, n.g, or 0 without a touch: (n,).

        points_w, tangents: (n, 2), one for each node.
        """
        near = self._map.near(points_w[:, 0], points_w[:, 1])
        gap = near.distance_m - self._set.radius_m
        frontal = np.abs(np.einsum("ij,ij->i", near.normal_w, tangents))
        beside = (near.obstacle != NONE) & (gap < self._set.skin_m) & (frontal < MAX_FRONTAL)
        towards = near.normal_w @ self._goal_w
        touches = beside & (towards > MIN_TOWARDS)
        places = points_w - near.normal_w * self._set.radius_m - self._origin_w
        direction = near.normal_w - self._set.peg_friction * tangents
        push = wrenches(places, direction)
        again = touches & (nodes.touched[:, -1] == near.obstacle)
        better = again & (gap < nodes.touch_gap_m[:, -1])
        new = touches & ~again
        for name, fresh in (("touched", near.obstacle), ("touch_gap_m", gap), ("push", push), ("touch_s_m", s_m)):
            slots = getattr(nodes, name)
            fresh_rows = fresh if isinstance(fresh, np.ndarray) else np.full(len(gap), fresh)
            slots[new, :-1] = slots[new, 1:]
            if name == "touch_s_m":
                slots[touches, -1] = fresh_rows[touches]
            else:
                slots[new | better, -1] = fresh_rows[new | better]
        return np.where(beside, towards, 0.0)

    def _margins(self, nodes: Layer) -> Floats:
        tail_s = nodes.s_m - self._set.body_length_m + self._set.loose_tail_m
        alive = (nodes.touch_s_m >= tail_s) & (nodes.touch_s_m <= nodes.s_m - self._set.loose_head_m)
        contacts = np.where(alive[..., None], nodes.push, 0.0)
        return margins_n(contacts, nodes.drag_m / self._set.body_length_m)

    def _left_behind(self, layers: Sequence[Layer], parents: Ints) -> Floats:
        """Drag over the arc that the tail leaves when these nodes of the newest layer get children."""
        if len(layers) <= self._arcs:
            return self._lying_drag_m[len(layers) - 1]
        rows = parents
        for older in reversed(layers[len(layers) - self._arcs + 1 :]):
            rows = older.parent[rows]
        return layers[-self._arcs].arc_drag_m[rows]

    def _expand(self, layers: Sequence[Layer]) -> Layer | None:
        """All children of the newest layer that do not collide, thinned out, with their cost.

        Until they are thinned out, arrays have a row a parent and a column a curvature: (n, c).
        """
        layer, config, count = layers[-1], self._set, len(self._bends_per_m)
        c, s = np.cos(layer.heading_rad)[:, None], np.sin(layer.heading_rad)[:, None]
        x0, y0 = layer.x_m[:, None], layer.y_m[:, None]
        xm, ym = x0 + c * self._middle_m[0] - s * self._middle_m[1], y0 + s * self._middle_m[0] + c * self._middle_m[1]
        x1, y1 = x0 + c * self._end_m[0] - s * self._end_m[1], y0 + s * self._end_m[0] + c * self._end_m[1]
        heading = layer.heading_rad[:, None] + self._bends_per_m * STEP_M
        free = self._fits(xm, ym, heading - 0.5 * self._bends_per_m * STEP_M) & self._fits(x1, y1, heading)
        off = np.abs(np.remainder(heading - self._goal_rad + np.pi, 2 * np.pi) - np.pi)
        free &= off < 1.75
        lies = self._lies_w
        away = None  # (n, c) distance in m to where the body lies
        if lies is not None and (k := round(layer.s_m / STEP_M) + 1) < len(lies):
            away = np.hypot(x1 - lies[k, 0], y1 - lies[k, 1])
            free &= away < self._reach_m
        bend_change = np.abs(self._bends_per_m - layer.bend_per_m[:, None])
        progress = (x1 - x0) * self._goal_w[0] + (y1 - y0) * self._goal_w[1]
        cost = layer.cost_m[:, None] + STEP_M + config.bend_m * STEP_M * bend_change - config.progress_reward * progress
        if away is not None and self._failed_w is not None:
            gaps = np.hypot(x1[..., None] - self._failed_w[:, 0], y1[..., None] - self._failed_w[:, 1]).min(axis=-1)
            cost = cost + STEP_M * config.failed_path_cost * np.maximum(1.0 - gaps / FAILED_M, 0.0)
        if away is not None:
            cost = cost + STEP_M * config.sideways_cost * (away / self._reach_m) ** 2
        rows = np.flatnonzero(free.ravel())
        if not len(rows):
            return None
        rows = rows[np.argsort(cost.ravel()[rows], kind="stable")]
        cells = _cells(x1.ravel()[rows], y1.ravel()[rows], heading.ravel()[rows], CELL_M, CELL_RAD)
        cheapest = np.sort(np.unique(cells, return_index=True)[1])  # of each cell
        rows = rows[cheapest[: 3 * config.kept_nodes]]
        parents = rows // count
        nodes = layer.take(parents)
        nodes.parent = parents
        nodes.x_m, nodes.y_m, nodes.heading_rad = x1.ravel()[rows], y1.ravel()[rows], heading.ravel()[rows]
        nodes.bend_per_m, nodes.cost_m = self._bends_per_m[rows % count], cost.ravel()[rows]
        nodes.s_m = layer.s_m + STEP_M
        middle = np.stack([xm.ravel()[rows], ym.ravel()[rows]], axis=-1)
        at = nodes.heading_rad - 0.5 * nodes.bend_per_m * STEP_M
        tangents = np.stack([np.cos(at), np.sin(at)], axis=-1)
        pushes = self._touch(nodes, middle, tangents, nodes.s_m - 0.5 * STEP_M)
        lying = lies is not None and nodes.s_m < config.body_length_m - 0.5 * STEP_M
        reward = config.push_reward_lying if lying else config.push_reward
        nodes.cost_m += STEP_M * np.where(pushes > 0, -reward * pushes, -config.brake_cost * pushes)
        nodes.arc_drag_m = STEP_M * wrenches(middle - self._origin_w, tangents)
        nodes.drag_m += nodes.arc_drag_m - self._left_behind(layers, parents)
        nodes.margin_n = self._margins(nodes)
        if not lying:
            weak = np.clip(1.0 - nodes.margin_n / config.wanted_margin_n, 0.0, 1.0)
            now = lies is not None and nodes.s_m < config.body_length_m + config.ahead_m
            nodes.cost_m += STEP_M * (config.weak_cost_ahead if now else config.weak_cost) * weak
        order = np.argsort(nodes.cost_m, kind="stable")
        places = _cells(nodes.x_m[order], nodes.y_m[order], nodes.heading_rad[order], WIDE_CELL_M, WIDE_CELL_RAD)
        return nodes.take(order[_rank(places) < config.kept_per_wide_cell][: config.kept_nodes])

    def _fits(self, x: Floats, y: Floats, heading: Floats) -> NDArray[np.bool_]:
        """Whether the body clears everything; x, y in m and heading in rad: (n, c)."""
        cuts = self._set.segment_m**2 * np.abs(self._bends_per_m) / 8
        clear_m = self._set.radius_m + self._set.clearance_m
        rough_m = self._map.roughly_m(x, y)
        fits = rough_m >= clear_m + cuts + ROUGH_M
        unsure = np.nonzero(~fits & (rough_m >= clear_m - ROUGH_M))
        near = self._map.near(x[unsure], y[unsure])
        at, curve = heading[unsure], unsure[1]
        left = np.cos(at) * near.normal_w[:, 1] - np.sin(at) * near.normal_w[:, 0]
        inner = left * np.sign(self._bends_per_m[curve]) < 0  # the obstacle is on the side towards which the path bends
        fits[unsure] = near.distance_m >= clear_m + np.where(inner, cuts[curve], 0.0)
        return fits

    def _trace(self, layers: list[Layer]) -> PlannedPath:
        row = int(np.argmin(layers[-1].cost_m))
        cost = float(layers[-1].cost_m[row])
        rows: list[int] = []
        for layer in reversed(layers):
            rows.append(row)
            row = int(layer.parent[row])
        picked = zip(layers, reversed(rows), strict=True)
        x, y, margin = np.array([(n.x_m[r], n.y_m[r], n.margin_n[r]) for n, r in picked]).T
        return PlannedPath(np.stack([x, y], axis=-1), margin, cost)


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
