"""A beam search for a path ahead of the head. Pure.

The search grows paths in layers of short arcs. It expands all nodes of a layer at once, with every allowed curvature,
and keeps the best few. Each node has the propulsion margin of the whole body with its head there (`search_nodes`).

The cost is in meters of path. For each meter of path it is

    1 - push_reward n.g                    if a contact pushes towards the goal (n.g > 0)
      + brake_cost |n.g|                   if a contact pushes back (n.g < 0)
      + weak_margin_cost max(0, 1 - F*/F_wanted)
      + curvature_change_cost_m |change of curvature|
      - progress_reward t.g
      + sideways_cost (d / d_max)^2        while the whole body is laid again
      + failed_path_cost max(0, 1 - e/e_0) likewise, near a path on which the body got stuck

    n    unit normal of a contact, from the obstacle to the body       g      unit vector to the goal
    t    unit tangent of the path                                      F*     propulsion margin in N (`margin`)
    d    distance from where the body lies                             e, e_0 distance from a failed path, FAILED_PATH_M

Points and headings are in the world frame. In shapes, n is the number of nodes and c the number of curvatures.

A search is a generator that returns the path. It yields the cost of its next step, in nodes to expand, before doing the
step. The caller decides how many steps it does at a time; the path does not depend on that.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import sample_back_from_end, wrenches
from snakesim_gnc.navigation.margin import compute_margins_n
from snakesim_gnc.navigation.obstacle_grid import NO_OBSTACLE, ObstacleGrid
from snakesim_gnc.navigation.search_arcs import STEP_M, ArcTable, SearchArcs
from snakesim_gnc.navigation.search_nodes import (
    NodeLayer,
    count_earlier_in_cell,
    make_start_nodes,
    number_cells,
)
from snakesim_gnc.navigation.search_parameters import SearchParameters
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]

MAX_HEADING_ERROR_RAD = 1.75  # a path heads no farther away from the goal

# Of the nodes in one narrow cell only the cheapest is kept: they are the same for the robot.
CELL_M = 0.02
CELL_RAD = np.pi / 18
# A wide cell keeps a limited number of nodes, so that other ways round an obstacle stay in the search.
WIDE_CELL_M = 0.1
WIDE_CELL_RAD = 0.6
CANDIDATES_PER_KEPT_NODE = 3  # nodes whose contacts are computed, for each one that is kept

MIN_PUSH = -0.1  # n.g of a contact that counts for the margin: `path_fit` moves the body off those that brake more
MAX_FRONTAL = 0.35  # |n.t| of a contact with the side of the body; beyond, the head bumps
FAILED_PATH_M = 0.025  # a path farther than this from a failed one is another path

# Where the search of a whole body begins: around the tail, and around its heading.
TAIL_OFFSETS_M = (-0.03, 0.0, 0.03)  # to the left
TAIL_TURNS_RAD = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])


@dataclass(frozen=True)
class SearchedPath:
    """A path that the search found."""

    points_w: Floats  # (n + 1, 2) one for every STEP_M
    margins_n: Floats  # (n + 1,) propulsion margin of the body with its head there
    cost_m: float


PathSearch = Generator[int, None, SearchedPath | None]  # yields the nodes of each step; returns None without a path


@dataclass(frozen=True)
class _Task:
    """The goal of one search, and the body from which it starts."""

    origin_w: Floats  # (2,) the head of the measured body; moments are about it
    goal_rad: float
    goal_w: Floats  # (2,) unit vector
    lying_drag_m: Floats  # (a, 3) drag of each arc of the body that the start node has, tail to head
    # For a search of the whole body.
    lying_w: Floats | None = None  # (a + 1, 2) where the body lies, tail to head
    max_sideways_m: float = np.inf  # how far the path may be from where the body lies
    failed_w: Floats | None = None  # (k, 2) points of paths on which the body got stuck here


class BeamSearch:
    """Searches paths from a body's head, or for the whole body, towards a direction."""

    def __init__(self, obstacles: ObstacleGrid, parameters: SearchParameters) -> None:
        self._obstacles = obstacles
        self._parameters = parameters
        self._arc_table = ArcTable(parameters)
        self._body_arcs = round(parameters.body_length_m / STEP_M)

    def search_ahead(self, body_w: Floats, goal_rad: float, steps: int) -> PathSearch:
        """Search the best path ahead of the head.

        Args:
            body_w: (n, 2) the body's curve, tail to head.
            goal_rad: direction of travel.
            steps: number of arcs.

        Returns:
            A path of that many arcs, or of as many as there is room for; None if there is no room for one.
        """
        lying_w = sample_back_from_end(body_w, STEP_M, self._body_arcs)
        origin_w = body_w[-1]
        middles_w, tangents = _middles_and_tangents(lying_w)
        task = _Task(
            origin_w=origin_w,
            goal_rad=goal_rad,
            goal_w=np.array([np.cos(goal_rad), np.sin(goal_rad)]),
            lying_drag_m=STEP_M * wrenches(middles_w - origin_w, tangents),
        )
        start = self._start_at_head(body_w, middles_w, tangents, task)
        return (yield from self._grow(start, steps, task))

    def search_whole_body(
        self, body_w: Floats, goal_rad: float, steps: int, max_sideways_m: float, failed_w: Floats | None = None
    ) -> PathSearch:
        """Search the best path for the whole body, which begins at the tail, and beyond the head.

        Args:
            body_w: (n, 2) the body's curve, tail to head.
            goal_rad: direction of travel.
            steps: number of arcs beyond the head.
            max_sideways_m: the path stays this near to where the body lies.
            failed_w: (k, 2) points of paths on which the body got stuck here; the search prefers other ways round.

        Returns:
            A path, which may have fewer arcs; None if there is none.
        """
        lying_w = sample_back_from_end(body_w, STEP_M, self._body_arcs)
        task = _Task(
            origin_w=body_w[-1],
            goal_rad=goal_rad,
            goal_w=np.array([np.cos(goal_rad), np.sin(goal_rad)]),
            lying_drag_m=np.zeros((self._body_arcs, 3)),
            lying_w=lying_w,
            max_sideways_m=max_sideways_m,
            failed_w=failed_w,
        )
        return (yield from self._grow(_start_at_tail(lying_w), self._body_arcs + steps, task))

    def _grow(self, start: NodeLayer, steps: int, task: _Task) -> PathSearch:
        """Expand layer after layer, and return the cheapest path."""
        layers = [start]
        for _ in range(steps):
            yield len(layers[-1].x_m)
            children = self._expand(layers, task)
            if children is None:
                break
            layers.append(children)
        if len(layers) == 1:
            return None
        return _trace_cheapest(layers)

    def _start_at_head(self, body_w: Floats, middles_w: Floats, tangents: Floats, task: _Task) -> NodeLayer:
        """Return the node of the body as it lies, with its contacts. middles_w, tangents: (a, 2) of its arcs."""
        ahead = body_w[-1:] - body_w[-2:-1]
        node = make_start_nodes(body_w[-1:], np.arctan2(ahead[:, 1], ahead[:, 0]))
        node.drag_m = task.lying_drag_m.sum(axis=0)[None]
        for arc in range(self._body_arcs):
            s_m = -STEP_M * (self._body_arcs - arc - 0.5)
            self._add_contacts(node, middles_w[None, arc], tangents[None, arc], s_m, task)
        node.margin_n = self._compute_margins_n(node)
        return node

    def _expand(self, layers: Sequence[NodeLayer], task: _Task) -> NodeLayer | None:
        """Return the best children of the newest layer, or None if none is free."""
        parents = layers[-1]
        arcs = self._arc_table.steer(parents)
        sideways_m = _distance_from_lying(arcs, parents.s_m, task)
        is_allowed = self._find_allowed(arcs, sideways_m, task)
        if not is_allowed.any():
            return None
        cost_m = self._path_cost_m(parents, arcs, sideways_m, task)
        candidates = self._pick_candidates(arcs, is_allowed, cost_m)
        nodes = self._make_nodes(parents, arcs, cost_m, candidates)
        self._add_contact_terms(nodes, layers, arcs, candidates, task)
        return self._thin_out(nodes)

    def _find_allowed(self, arcs: SearchArcs, sideways_m: Floats | None, task: _Task) -> Bools:
        """Return which arcs clear all obstacles and lead about the right way, (n, c)."""
        is_allowed = self._arc_table.clears_obstacles(
            self._obstacles, arcs.middle_x_m, arcs.middle_y_m, arcs.middle_heading_rad
        )
        is_allowed &= self._arc_table.clears_obstacles(self._obstacles, arcs.x_m, arcs.y_m, arcs.heading_rad)
        heading_error_rad = np.abs(np.remainder(arcs.heading_rad - task.goal_rad + np.pi, 2 * np.pi) - np.pi)
        is_allowed &= heading_error_rad < MAX_HEADING_ERROR_RAD
        if sideways_m is not None:
            is_allowed &= sideways_m < task.max_sideways_m
        return is_allowed

    def _path_cost_m(self, parents: NodeLayer, arcs: SearchArcs, sideways_m: Floats | None, task: _Task) -> Floats:
        """Return the cost of the paths to the ends of the arcs, without the terms of the last contacts, (n, c)."""
        parameters = self._parameters
        curvature_change = np.abs(self._arc_table.curvatures_per_m - parents.curvature_per_m[:, None])
        step_x = arcs.x_m - parents.x_m[:, None]
        step_y = arcs.y_m - parents.y_m[:, None]
        progress_m = step_x * task.goal_w[0] + step_y * task.goal_w[1]
        cost_m = (
            parents.cost_m[:, None]
            + STEP_M
            + parameters.curvature_change_cost_m * STEP_M * curvature_change
            - parameters.progress_reward * progress_m
        )
        if sideways_m is None:
            return cost_m
        if task.failed_w is not None:
            to_failed_x = arcs.x_m[..., None] - task.failed_w[:, 0]
            to_failed_y = arcs.y_m[..., None] - task.failed_w[:, 1]
            to_failed_m = np.hypot(to_failed_x, to_failed_y).min(axis=-1)
            closeness = np.maximum(1.0 - to_failed_m / FAILED_PATH_M, 0.0)
            cost_m = cost_m + STEP_M * parameters.failed_path_cost * closeness
        return cost_m + STEP_M * parameters.sideways_cost * (sideways_m / task.max_sideways_m) ** 2

    def _pick_candidates(self, arcs: SearchArcs, is_allowed: Bools, cost_m: Floats) -> Ints:
        """Return the indices into the raveled arcs of the cheapest allowed one in each cell, the cheapest first."""
        allowed = np.flatnonzero(is_allowed.ravel())
        cheapest_first = allowed[np.argsort(cost_m.ravel()[allowed], kind="stable")]
        cells = number_cells(
            arcs.x_m.ravel()[cheapest_first],
            arcs.y_m.ravel()[cheapest_first],
            arcs.heading_rad.ravel()[cheapest_first],
            CELL_M,
            CELL_RAD,
        )
        _, first_of_cell = np.unique(cells, return_index=True)
        first_of_cell = np.sort(first_of_cell)
        return cheapest_first[first_of_cell[: CANDIDATES_PER_KEPT_NODE * self._parameters.kept_nodes]]

    def _make_nodes(self, parents: NodeLayer, arcs: SearchArcs, cost_m: Floats, candidates: Ints) -> NodeLayer:
        """Return nodes at the ends of some arcs, with the contacts and the drag of their parents."""
        curvature_count = len(self._arc_table.curvatures_per_m)
        parent_rows = candidates // curvature_count
        nodes = parents.select_rows(parent_rows)
        nodes.parent = parent_rows
        nodes.x_m = arcs.x_m.ravel()[candidates]
        nodes.y_m = arcs.y_m.ravel()[candidates]
        nodes.heading_rad = arcs.heading_rad.ravel()[candidates]
        nodes.curvature_per_m = self._arc_table.curvatures_per_m[candidates % curvature_count]
        nodes.cost_m = cost_m.ravel()[candidates]
        nodes.s_m = parents.s_m + STEP_M
        return nodes

    def _add_contact_terms(
        self, nodes: NodeLayer, layers: Sequence[NodeLayer], arcs: SearchArcs, candidates: Ints, task: _Task
    ) -> None:
        """Add the contacts and the drag of the newest arc to nodes, and what they cost. layers: without the nodes."""
        parameters = self._parameters
        middles_w = np.stack([arcs.middle_x_m.ravel()[candidates], arcs.middle_y_m.ravel()[candidates]], axis=-1)
        headings_rad = arcs.middle_heading_rad.ravel()[candidates]
        tangents = np.stack([np.cos(headings_rad), np.sin(headings_rad)], axis=-1)

        # While the search is still within the body, the margin has no meaning yet.
        is_relaid = task.lying_w is not None
        is_within_body = is_relaid and nodes.s_m < parameters.body_length_m - 0.5 * STEP_M
        push_reward = parameters.push_reward_of_body if is_within_body else parameters.push_reward
        push = self._add_contacts(nodes, middles_w, tangents, nodes.s_m - 0.5 * STEP_M, task)
        nodes.cost_m += STEP_M * np.where(push > 0, -push_reward * push, -parameters.brake_cost * push)

        nodes.arc_drag_m = STEP_M * wrenches(middles_w - task.origin_w, tangents)
        nodes.drag_m += nodes.arc_drag_m - self._drag_left_behind_m(layers, nodes.parent, task)
        nodes.margin_n = self._compute_margins_n(nodes)
        if is_within_body:
            return
        is_near = is_relaid and nodes.s_m < parameters.body_length_m + parameters.near_m
        weak_margin_cost = parameters.weak_margin_cost_near if is_near else parameters.weak_margin_cost
        weakness = np.clip(1.0 - nodes.margin_n / parameters.wanted_margin_n, 0.0, 1.0)
        nodes.cost_m += STEP_M * weak_margin_cost * weakness

    def _add_contacts(self, nodes: NodeLayer, points_w: Floats, tangents: Floats, s_m: float, task: _Task) -> Floats:
        """Store what the body touches at one arc length of each node's path.

        Args:
            nodes: the nodes, which are changed.
            points_w: (n, 2) on the body's axis.
            tangents: (n, 2) unit vectors along it.
            s_m: arc length of the points.
            task: the search.

        Returns:
            (n,) the push towards the goal n.g, 0 without a contact.
        """
        parameters = self._parameters
        nearest = self._obstacles.find_nearest(points_w[:, 0], points_w[:, 1])
        normals = nearest.normal_w
        gap_m = nearest.distance_m - parameters.radius_m
        frontal = np.abs(np.einsum("ij,ij->i", normals, tangents))
        is_contact = (
            (nearest.obstacle != NO_OBSTACLE) & (gap_m < parameters.contact_distance_m) & (frontal < MAX_FRONTAL)
        )
        push = normals @ task.goal_w
        skin_from_origin = points_w - normals * parameters.radius_m - task.origin_w
        unit_push = normals - parameters.assumed_obstacle_friction * tangents
        nodes.add_contacts(
            touches=is_contact & (push > MIN_PUSH),
            obstacle=nearest.obstacle,
            gap_m=gap_m,
            wrench=wrenches(skin_from_origin, unit_push),
            s_m=s_m,
        )
        return np.where(is_contact, push, 0.0)

    def _compute_margins_n(self, nodes: NodeLayer) -> Floats:
        """Return the propulsion margin of each body, (n,), with the contacts that are not near its ends."""
        parameters = self._parameters
        first_s_m = nodes.s_m - parameters.body_length_m + parameters.unused_tail_m
        last_s_m = nodes.s_m - parameters.unused_head_m
        counts = (nodes.contact_s_m >= first_s_m) & (nodes.contact_s_m <= last_s_m)
        contacts = np.where(counts[..., None], nodes.contact_wrench, 0.0)
        return compute_margins_n(contacts, nodes.drag_m / parameters.body_length_m)

    def _drag_left_behind_m(self, layers: Sequence[NodeLayer], parent_rows: Ints, task: _Task) -> Floats:
        """Return the drag of the arc that the tail leaves when the head enters the next arc, (n, 3) or (3,).

        The tail is one body length behind the head: on the body as it lay at first, and then on the path.
        """
        if len(layers) <= self._body_arcs:
            return task.lying_drag_m[len(layers) - 1]
        rows = parent_rows
        for older in reversed(layers[len(layers) - self._body_arcs + 1 :]):
            rows = older.parent[rows]
        return layers[-self._body_arcs].arc_drag_m[rows]

    def _thin_out(self, nodes: NodeLayer) -> NodeLayer:
        """Return the cheapest nodes, with a limited number in each wide cell."""
        order = np.argsort(nodes.cost_m, kind="stable")
        cells = number_cells(nodes.x_m[order], nodes.y_m[order], nodes.heading_rad[order], WIDE_CELL_M, WIDE_CELL_RAD)
        is_kept = count_earlier_in_cell(cells) < self._parameters.kept_per_wide_cell
        return nodes.select_rows(order[is_kept][: self._parameters.kept_nodes])


def _middles_and_tangents(points_w: Floats) -> tuple[Floats, Floats]:
    """Return the middles and unit directions, (k, 2) each, of the chords between points (k + 1, 2)."""
    chords = np.diff(points_w, axis=0)
    lengths_m = np.maximum(np.hypot(chords[:, 0], chords[:, 1]), 1e-9)
    return 0.5 * (points_w[1:] + points_w[:-1]), chords / lengths_m[:, None]


def _start_at_tail(lying_w: Floats) -> NodeLayer:
    """Return nodes around the tail end of a lying body, as starts of the path of the whole body."""
    tail_w = lying_w[0]
    ahead = lying_w[1] - tail_w
    heading_rad = float(np.arctan2(ahead[1], ahead[0]))
    left = np.array([-np.sin(heading_rad), np.cos(heading_rad)])
    turns = len(TAIL_TURNS_RAD)
    points_w = np.concatenate([np.tile(tail_w + offset_m * left, (turns, 1)) for offset_m in TAIL_OFFSETS_M])
    return make_start_nodes(points_w, np.tile(heading_rad + TAIL_TURNS_RAD, len(TAIL_OFFSETS_M)))


def _distance_from_lying(arcs: SearchArcs, parent_s_m: float, task: _Task) -> Floats | None:
    """Return how far the ends of the arcs are from where the body lies at the same arc length, (n, c).

    None if the body is not laid again, or if the arcs are ahead of its head.
    """
    if task.lying_w is None:
        return None
    end = round(parent_s_m / STEP_M) + 1
    if end >= len(task.lying_w):
        return None
    return np.hypot(arcs.x_m - task.lying_w[end, 0], arcs.y_m - task.lying_w[end, 1])


def _trace_cheapest(layers: Sequence[NodeLayer]) -> SearchedPath:
    """Follow the parents of the cheapest node of the last layer back to the start."""
    row = int(np.argmin(layers[-1].cost_m))
    cost_m = float(layers[-1].cost_m[row])
    points: list[tuple[float, float]] = []
    margins: list[float] = []
    for layer in reversed(layers):
        points.append((layer.x_m[row], layer.y_m[row]))
        margins.append(layer.margin_n[row])
        row = int(layer.parent[row])
    return SearchedPath(np.array(points[::-1]), np.array(margins[::-1]), cost_m)
