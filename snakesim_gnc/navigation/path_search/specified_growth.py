"""How a beam search makes its paths longer by one layer of arcs: the specification. Pure.

`native_growth` computes the same numbers in C, about seven times as fast. This module is what a reader should trust: it
explains the search, the tests compare the two bit for bit, and it plans where the C library is not installed. A change
here needs the same change in `snakesim_native/planner/`.

In shapes, n is the number of nodes and c the number of curvatures. Points and headings are in the world frame.
"""

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import wrenches
from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.body_contacts import compute_node_margins_n, find_touched
from snakesim_gnc.navigation.path_search.path_growth import PathGrowth
from snakesim_gnc.navigation.path_search.search_arcs import ArcTable, SearchArcs
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer, count_earlier_in_cell, number_cells
from snakesim_gnc.navigation.path_search.search_parameters import (
    CANDIDATES_PER_KEPT_NODE,
    CELL_M,
    CELL_RAD,
    FAILED_PATH_M,
    MAX_HEADING_ERROR_RAD,
    STEP_M,
    WIDE_CELL_M,
    WIDE_CELL_RAD,
    SearchParameters,
    count_body_arcs,
)
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


class SpecifiedGrowth(PathGrowth):
    """Grows paths with NumPy, in the words of the cost's equation in `beam`."""

    def __init__(
        self, obstacles: ObstacleGrid, parameters: SearchParameters, task: SearchTask, start: NodeLayer, steps: int
    ) -> None:
        del steps  # memory is allocated layer by layer
        self._obstacles = obstacles
        self._parameters = parameters
        self._task = task
        self._arc_table = ArcTable(parameters)
        self._body_arcs = count_body_arcs(parameters)
        self._layers = [start]

    @property
    def node_count(self) -> int:
        return len(self._layers[-1].x_m)

    def grow(self) -> bool:
        parents = self._layers[-1]
        arcs = self._arc_table.steer(parents)
        sideways_m = self._distance_from_initial_body(arcs, parents.s_m)
        is_allowed = self._find_allowed(arcs, sideways_m)
        if not is_allowed.any():
            return False
        cost_m = self._path_cost_m(parents, arcs, sideways_m)
        candidates = self._pick_candidates(arcs, is_allowed, cost_m)
        nodes = self._make_nodes(parents, arcs, cost_m, candidates)
        self._add_contact_terms(nodes, arcs, candidates)
        self._layers.append(self._thin_out(nodes))
        return True

    def trace_cheapest(self) -> SearchedPath | None:
        if len(self._layers) == 1:
            return None
        newest = self._layers[-1]
        row = int(np.argmin(newest.cost_m))
        cost_m = float(newest.cost_m[row])
        points: list[tuple[float, float]] = []
        margins: list[float] = []
        for layer in reversed(self._layers):
            points.append((layer.x_m[row], layer.y_m[row]))
            margins.append(layer.margin_n[row])
            row = int(layer.parent[row])
        return SearchedPath(np.array(points[::-1]), np.array(margins[::-1]), cost_m)

    def _distance_from_initial_body(self, arcs: SearchArcs, parent_s_m: float) -> Floats | None:
        """Return how far the ends of the arcs are from where the body lies at the same arc length, (n, c).

        None if the search does not start at the tail, or if the arcs are ahead of the measured head.
        """
        initial_body_w = self._task.initial_body_w
        if initial_body_w is None:
            return None
        end = round(parent_s_m / STEP_M) + 1
        if end >= len(initial_body_w):
            return None
        return np.hypot(arcs.x_m - initial_body_w[end, 0], arcs.y_m - initial_body_w[end, 1])

    def _find_allowed(self, arcs: SearchArcs, sideways_m: Floats | None) -> Bools:
        """Return which arcs clear all obstacles and lead about the right way, (n, c)."""
        is_allowed = self._arc_table.clears_obstacles(
            self._obstacles, arcs.middle_x_m, arcs.middle_y_m, arcs.middle_heading_rad
        )
        is_allowed &= self._arc_table.clears_obstacles(self._obstacles, arcs.x_m, arcs.y_m, arcs.heading_rad)
        from_goal_rad = arcs.heading_rad - self._task.goal_rad
        heading_error_rad = np.abs(np.remainder(from_goal_rad + np.pi, 2 * np.pi) - np.pi)
        is_allowed &= heading_error_rad < MAX_HEADING_ERROR_RAD
        if sideways_m is not None:
            is_allowed &= sideways_m < self._task.max_sideways_m
        return is_allowed

    def _path_cost_m(self, parents: NodeLayer, arcs: SearchArcs, sideways_m: Floats | None) -> Floats:
        """Return the cost of the paths to the ends of the arcs, without the terms of the last contacts.

        It is the cost of the parent, plus length and change of curvature, minus progress towards the goal. A search of
        the whole body also adds the distance from the present body and the closeness to paths that have failed.

        Args:
            parents: (n) nodes at which the arcs begin.
            arcs: (n, c) arcs, one for each node and curvature.
            sideways_m: (n, c) distance of the ends from the present body; None if this does not count.

        Returns:
            (n, c) costs in m.
        """
        parameters = self._parameters
        task = self._task
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

    def _add_contact_terms(self, nodes: NodeLayer, arcs: SearchArcs, candidates: Ints) -> None:
        """Add to new nodes what the body meets on their newest arcs: contacts, drag, and the costs of both.

        A search of the whole body begins at the tail, and first follows the body where it already lies. Until the path
        is one body length long, it is no complete body, and has no propulsion margin.

        Args:
            nodes: the n new nodes; their contacts, drag, margins and costs are changed.
            arcs: all arcs from the parents of these nodes.
            candidates: (n,) index of each node's arc among the flattened arcs.
        """
        middles_w = np.stack([arcs.middle_x_m.ravel()[candidates], arcs.middle_y_m.ravel()[candidates]], axis=-1)
        headings_rad = arcs.middle_heading_rad.ravel()[candidates]
        tangents = np.stack([np.cos(headings_rad), np.sin(headings_rad)], axis=-1)

        starts_at_tail = self._task.initial_body_w is not None
        is_incomplete = starts_at_tail and nodes.s_m < self._parameters.body_length_m - 0.5 * STEP_M
        self._add_contacts(nodes, middles_w, tangents, is_incomplete=is_incomplete)
        self._add_drag(nodes, middles_w, tangents)
        # The margin depends on the contacts and the drag, which are complete now.
        nodes.margin_n = compute_node_margins_n(nodes, self._parameters)
        if not is_incomplete:
            self._add_margin_cost(nodes)

    def _add_contacts(self, nodes: NodeLayer, middles_w: Floats, tangents: Floats, *, is_incomplete: bool) -> None:
        """Store the contacts of the newest arcs, and add their cost: negative if they propel, positive if they brake.

        Args:
            nodes: the n new nodes, whose contacts and costs are changed.
            middles_w: (n, 2) middles of their newest arcs, m.
            tangents: (n, 2) unit vectors along these arcs.
            is_incomplete: whether the path is still shorter than the body.
        """
        parameters = self._parameters
        touched = find_touched(self._obstacles, middles_w, tangents, parameters, self._task)
        middle_s_m = nodes.s_m - 0.5 * STEP_M
        nodes.add_contacts(touched.is_usable, touched.obstacle, touched.gap_m, touched.wrench, middle_s_m)
        push_reward = parameters.push_reward_of_body if is_incomplete else parameters.push_reward
        propulsion = touched.propulsion
        reward_cost = -push_reward * propulsion
        brake_cost = -parameters.brake_cost * propulsion
        nodes.cost_m += STEP_M * np.where(propulsion > 0, reward_cost, brake_cost)

    def _add_drag(self, nodes: NodeLayer, middles_w: Floats, tangents: Floats) -> None:
        """Move the body's drag one arc forward: add the arc that the head enters, and subtract the one the tail leaves.

        Args:
            nodes: the n new nodes, whose drag is changed.
            middles_w: (n, 2) middles of their newest arcs, m.
            tangents: (n, 2) unit vectors along these arcs.
        """
        nodes.arc_drag_m = STEP_M * wrenches(middles_w - self._task.origin_w, tangents)
        nodes.drag_m += nodes.arc_drag_m - self._drag_at_tail_m(nodes.parent)

    def _add_margin_cost(self, nodes: NodeLayer) -> None:
        """Add the cost of propulsion margins below the wanted one; it is higher just ahead of the measured head."""
        parameters = self._parameters
        starts_at_tail = self._task.initial_body_w is not None
        is_just_ahead = starts_at_tail and nodes.s_m < parameters.body_length_m + parameters.near_m
        weak_margin_cost = parameters.weak_margin_cost_near if is_just_ahead else parameters.weak_margin_cost
        # 0 with the wanted margin, 1 without any.
        missing_fraction = np.clip(1.0 - nodes.margin_n / parameters.wanted_margin_n, 0.0, 1.0)
        nodes.cost_m += STEP_M * weak_margin_cost * missing_fraction

    def _drag_at_tail_m(self, parent_rows: Ints) -> Floats:
        """Return the drag integral of the arc that the tail leaves when the head enters the next arc.

        That arc is one body length behind the head: on the initial body as long as the path is shorter than a body, and
        then on the path.

        Args:
            parent_rows: (n,) rows of the nodes, in the newest layer, from which the head moves on.

        Returns:
            (n, 3) drag in m, m, m² for each node; or (3,), equal for all, while the tail is on the initial body.
        """
        layers = self._layers
        if len(layers) <= self._body_arcs:
            return self._task.initial_drag_m[len(layers) - 1]
        rows = parent_rows
        for layer in reversed(layers[len(layers) - self._body_arcs + 1 :]):
            rows = layer.parent[rows]
        return layers[-self._body_arcs].arc_drag_m[rows]

    def _thin_out(self, nodes: NodeLayer) -> NodeLayer:
        """Return the cheapest nodes, with a limited number in each wide cell."""
        order = np.argsort(nodes.cost_m, kind="stable")
        cells = number_cells(nodes.x_m[order], nodes.y_m[order], nodes.heading_rad[order], WIDE_CELL_M, WIDE_CELL_RAD)
        is_kept = count_earlier_in_cell(cells) < self._parameters.kept_per_wide_cell
        return nodes.select_rows(order[is_kept][: self._parameters.kept_nodes])
