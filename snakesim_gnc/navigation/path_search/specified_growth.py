"""How a beam search makes its paths longer by one layer of arcs: the specification. Pure.

`native_growth` computes the same numbers in C, about seven times as fast. This module is what a reader should trust: it
explains the search, the tests compare the two bit for bit, and it plans where the C library is not installed. A change
here needs the same change in `snakesim_native/planner/`.

In shapes, n is the number of nodes and c the number of curvatures. Points and headings are in the world frame.
"""

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import compute_wrenches
from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.body_contacts import (
    compute_node_margins_n,
    find_obstacle_contacts,
)
from snakesim_gnc.navigation.path_search.path_growth import PathExpander
from snakesim_gnc.navigation.path_search.search_arcs import ArcTable, SearchArcs
from snakesim_gnc.navigation.path_search.search_nodes import (
    NodeLayer,
    compute_cell_numbers,
    count_earlier_in_cell,
)
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
    count_arcs_per_body,
)
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


class NumpyExpander(PathExpander):
    """Grows paths with NumPy, in the words of the cost's equation in `beam`."""

    def __init__(
        self,
        obstacles: ObstacleGrid,
        parameters: SearchParameters,
        task: SearchTask,
        start_nodes: NodeLayer,
        max_arc_count: int,
    ) -> None:
        del max_arc_count  # memory is allocated layer by layer
        self._obstacles = obstacles
        self._parameters = parameters
        self._task = task
        self._arc_table = ArcTable(parameters)
        self._arcs_per_body = count_arcs_per_body(parameters)
        self._layers = [start_nodes]

    @property
    def node_count(self) -> int:
        return len(self._layers[-1].x_m)

    def expand_layer(self) -> bool:
        """Add a layer with the best children of the newest one; return False if no arc is allowed."""
        parents = self._layers[-1]
        arcs = self._arc_table.make_arcs(parents)
        distances_from_initial_body_m = self._compute_distances_from_initial_body_m(
            arcs, parents.path_length_m
        )
        is_allowed = self._find_allowed_arcs(arcs, distances_from_initial_body_m)
        if not is_allowed.any():
            return False
        cost_m = self._compute_path_costs_m(parents, arcs, distances_from_initial_body_m)
        arc_indices = self._select_candidates(arcs, is_allowed, cost_m)
        nodes = self._make_nodes(parents, arcs, cost_m, arc_indices)
        self._add_contact_terms(nodes, arcs, arc_indices)
        self._layers.append(self._keep_best_nodes(nodes))
        return True

    def trace_cheapest(self) -> SearchedPath | None:
        """Follow the parents of the cheapest node of the newest layer back to the start, and return that path."""
        if len(self._layers) == 1:
            return None
        newest = self._layers[-1]
        row = int(np.argmin(newest.cost_m))
        cost_m = float(newest.cost_m[row])
        points: list[tuple[float, float]] = []
        margins: list[float] = []
        for layer in reversed(self._layers):
            points.append((layer.x_m[row], layer.y_m[row]))
            margins.append(layer.propulsion_margin_n[row])
            row = int(layer.parent_row[row])
        return SearchedPath(np.array(points[::-1]), np.array(margins[::-1]), cost_m)

    def _compute_distances_from_initial_body_m(
        self, arcs: SearchArcs, parent_s_m: float
    ) -> Floats | None:
        """Compute the distances of the ends of the arcs from where the body lies at the same arc length.

        Args:
            arcs: (n, c) arcs, one for each node and curvature.
            parent_s_m: Arc length at which the arcs begin.

        Returns:
            (n, c) distances in m, or None if the search does not start at the tail, or if the arcs are ahead of the
            measured head.
        """
        initial_body_w = self._task.initial_body_w
        if initial_body_w is None:
            return None
        arc_end_index = round(parent_s_m / STEP_M) + 1
        if arc_end_index >= len(initial_body_w):
            return None
        return np.hypot(
            arcs.end_x_m - initial_body_w[arc_end_index, 0],
            arcs.end_y_m - initial_body_w[arc_end_index, 1],
        )

    def _find_allowed_arcs(
        self, arcs: SearchArcs, distances_from_initial_body_m: Floats | None
    ) -> Bools:
        """Find the arcs on which the body clears all obstacles and heads roughly towards the goal.

        Args:
            arcs: (n, c) arcs, one for each node and curvature.
            distances_from_initial_body_m: (n, c) distances of the ends of the arcs from where the body lies; None if
                they do not count.

        Returns:
            (n, c) whether each arc is allowed.
        """
        # The body must clear all obstacles at the middle of each arc and at its end.
        is_allowed = self._arc_table.find_clear_poses(
            self._obstacles, arcs.middle_x_m, arcs.middle_y_m, arcs.middle_heading_rad
        )
        is_allowed &= self._arc_table.find_clear_poses(
            self._obstacles, arcs.end_x_m, arcs.end_y_m, arcs.end_heading_rad
        )
        # Angle between the end of the arc and the direction of travel, 0 to pi.
        from_goal_rad = arcs.end_heading_rad - self._task.travel_direction_rad
        heading_error_rad = np.abs(np.remainder(from_goal_rad + np.pi, 2 * np.pi) - np.pi)
        is_allowed &= heading_error_rad < MAX_HEADING_ERROR_RAD
        if distances_from_initial_body_m is not None:
            is_allowed &= distances_from_initial_body_m < self._task.max_sideways_m
        return is_allowed

    def _compute_path_costs_m(
        self, parents: NodeLayer, arcs: SearchArcs, distances_from_initial_body_m: Floats | None
    ) -> Floats:
        """Return the cost of the paths to the ends of the arcs, without the terms of the last contacts.

        It is the cost of the parent, plus length and change of curvature, minus progress towards the goal. A search of
        the whole body also adds the distance from the current body and the closeness to paths that have failed.

        Args:
            parents: (n) nodes at which the arcs begin.
            arcs: (n, c) arcs, one for each node and curvature.
            distances_from_initial_body_m: (n, c) distances of the ends of the arcs from where the body lies; None if
                they do not count.

        Returns:
            (n, c) costs in m.
        """
        parameters = self._parameters
        task = self._task
        curvature_change = np.abs(
            self._arc_table.curvatures_per_m - parents.curvature_per_m[:, None]
        )
        step_x = arcs.end_x_m - parents.x_m[:, None]
        step_y = arcs.end_y_m - parents.y_m[:, None]
        progress_m = step_x * task.travel_direction_w[0] + step_y * task.travel_direction_w[1]
        cost_m = (
            parents.cost_m[:, None]
            + STEP_M
            + parameters.curvature_change_cost_m * STEP_M * curvature_change
            - parameters.progress_reward * progress_m
        )
        if distances_from_initial_body_m is None:
            return cost_m
        if task.failed_w is not None:
            to_failed_x = arcs.end_x_m[..., None] - task.failed_w[:, 0]
            to_failed_y = arcs.end_y_m[..., None] - task.failed_w[:, 1]
            failed_path_distance_m = np.hypot(to_failed_x, to_failed_y).min(axis=-1)
            closeness = np.maximum(1.0 - failed_path_distance_m / FAILED_PATH_M, 0.0)
            cost_m = cost_m + STEP_M * parameters.failed_path_cost * closeness
        return (
            cost_m
            + STEP_M
            * parameters.sideways_cost
            * (distances_from_initial_body_m / task.max_sideways_m) ** 2
        )

    def _select_candidates(self, arcs: SearchArcs, is_allowed: Bools, cost_m: Floats) -> Ints:
        """Select the cheapest allowed arc in each cell of position and heading, up to a maximum number.

        Args:
            arcs: (n, c) arcs, one for each node and curvature.
            is_allowed: (n, c) whether each arc is allowed.
            cost_m: (n, c) cost of the path to the end of each arc, m.

        Returns:
            Indices into the flattened arcs, the cheapest first.
        """
        allowed_indices = np.flatnonzero(is_allowed.ravel())
        cheapest_first = allowed_indices[np.argsort(cost_m.ravel()[allowed_indices], kind="stable")]
        cells = compute_cell_numbers(
            arcs.end_x_m.ravel()[cheapest_first],
            arcs.end_y_m.ravel()[cheapest_first],
            arcs.end_heading_rad.ravel()[cheapest_first],
            CELL_M,
            CELL_RAD,
        )
        _, first_of_cell = np.unique(cells, return_index=True)
        first_of_cell = np.sort(first_of_cell)
        return cheapest_first[
            first_of_cell[: CANDIDATES_PER_KEPT_NODE * self._parameters.kept_nodes]
        ]

    def _make_nodes(
        self, parents: NodeLayer, arcs: SearchArcs, cost_m: Floats, arc_indices: Ints
    ) -> NodeLayer:
        """Make nodes at the ends of the selected arcs, with the contacts and the drag of their parents.

        Args:
            parents: (n) nodes at which the arcs begin.
            arcs: (n, c) arcs, one for each node and curvature.
            cost_m: (n, c) cost of the path to the end of each arc, m.
            arc_indices: Indices of the selected arcs among the flattened arcs.
        """
        curvature_count = len(self._arc_table.curvatures_per_m)
        parent_rows = arc_indices // curvature_count
        nodes = parents.select_rows(parent_rows)
        nodes.parent_row = parent_rows
        nodes.x_m = arcs.end_x_m.ravel()[arc_indices]
        nodes.y_m = arcs.end_y_m.ravel()[arc_indices]
        nodes.heading_rad = arcs.end_heading_rad.ravel()[arc_indices]
        nodes.curvature_per_m = self._arc_table.curvatures_per_m[arc_indices % curvature_count]
        nodes.cost_m = cost_m.ravel()[arc_indices]
        nodes.path_length_m = parents.path_length_m + STEP_M
        return nodes

    def _add_contact_terms(self, nodes: NodeLayer, arcs: SearchArcs, arc_indices: Ints) -> None:
        """Add the contacts and the drag along the arc that leads to each new node, and the costs of both.

        A search of the whole body begins at the tail, and first follows the body where it already lies. Until the path
        is one body length long, the body is incomplete, and its propulsion margin does not count.

        Args:
            nodes: The n new nodes; their contacts, drag, margins and costs are changed.
            arcs: All arcs from the parents of these nodes.
            arc_indices: (n,) index of each node's arc among the flattened arcs.
        """
        middles_w = np.stack(
            [arcs.middle_x_m.ravel()[arc_indices], arcs.middle_y_m.ravel()[arc_indices]], axis=-1
        )
        headings_rad = arcs.middle_heading_rad.ravel()[arc_indices]
        tangents = np.stack([np.cos(headings_rad), np.sin(headings_rad)], axis=-1)

        # Only a search of the whole body has an initial body.
        starts_at_tail = self._task.initial_body_w is not None
        # All nodes of a layer have the same arc length; half an arc allows for rounding of its sum.
        is_incomplete = (
            starts_at_tail and nodes.path_length_m < self._parameters.body_length_m - 0.5 * STEP_M
        )
        self._add_contacts(nodes, middles_w, tangents, is_incomplete=is_incomplete)
        self._add_drag(nodes, middles_w, tangents)
        # The margin depends on the contacts and the drag, which are complete now.
        nodes.propulsion_margin_n = compute_node_margins_n(nodes, self._parameters)
        if not is_incomplete:
            self._add_margin_cost(nodes)

    def _add_contacts(
        self, nodes: NodeLayer, middles_w: Floats, tangents: Floats, *, is_incomplete: bool
    ) -> None:
        """Store the contacts of the newest arcs, and add their cost: negative if they propel, positive if they brake.

        Args:
            nodes: The n new nodes, whose contacts and costs are changed.
            middles_w: (n, 2) middles of their newest arcs, m.
            tangents: (n, 2) unit vectors along these arcs.
            is_incomplete: Whether the path is still shorter than the body.
        """
        parameters = self._parameters
        contacts = find_obstacle_contacts(
            self._obstacles, middles_w, tangents, parameters, self._task
        )
        middle_s_m = nodes.path_length_m - 0.5 * STEP_M
        nodes.add_contacts(
            contacts.is_usable, contacts.obstacle, contacts.gap_m, contacts.wrench, middle_s_m
        )
        push_reward = parameters.push_reward_of_body if is_incomplete else parameters.push_reward
        propulsion = contacts.propulsion
        reward_cost = -push_reward * propulsion
        brake_cost = -parameters.brake_cost * propulsion
        nodes.cost_m += STEP_M * np.where(propulsion > 0, reward_cost, brake_cost)

    def _add_drag(self, nodes: NodeLayer, middles_w: Floats, tangents: Floats) -> None:
        """Move the body's drag one arc forward: add the arc that the head enters, and subtract the one the tail leaves.

        Args:
            nodes: The n new nodes, whose drag is changed.
            middles_w: (n, 2) middles of their newest arcs, m.
            tangents: (n, 2) unit vectors along these arcs.
        """
        nodes.arc_drag_m = STEP_M * compute_wrenches(middles_w - self._task.origin_w, tangents)
        nodes.drag_m += nodes.arc_drag_m - self._get_drag_at_tail_m(nodes.parent_row)

    def _add_margin_cost(self, nodes: NodeLayer) -> None:
        """Add the cost of propulsion margins below the wanted one; it is higher just ahead of the measured head."""
        parameters = self._parameters
        starts_at_tail = self._task.initial_body_w is not None
        is_just_ahead = (
            starts_at_tail and nodes.path_length_m < parameters.body_length_m + parameters.near_m
        )
        weak_margin_cost = (
            parameters.weak_margin_cost_near if is_just_ahead else parameters.weak_margin_cost
        )
        # 0 with the wanted margin, 1 without any.
        missing_fraction = np.clip(
            1.0 - nodes.propulsion_margin_n / parameters.wanted_margin_n, 0.0, 1.0
        )
        nodes.cost_m += STEP_M * weak_margin_cost * missing_fraction

    def _get_drag_at_tail_m(self, parent_rows: Ints) -> Floats:
        """Return the drag integral of the arc that the tail leaves when the head enters the next arc.

        That arc is one body length behind the head: on the initial body as long as the path is shorter than a body, and
        then on the path.

        Args:
            parent_rows: (n,) rows of the nodes, in the newest layer, from which the head moves on.

        Returns:
            (n, 3) drag in m, m, m² for each node; or (3,), equal for all, while the tail is on the initial body.
        """
        layers = self._layers
        if len(layers) <= self._arcs_per_body:
            return self._task.initial_drag_m[len(layers) - 1]
        rows = parent_rows
        for layer in reversed(layers[len(layers) - self._arcs_per_body + 1 :]):
            rows = layer.parent_row[rows]
        return layers[-self._arcs_per_body].arc_drag_m[rows]

    def _keep_best_nodes(self, nodes: NodeLayer) -> NodeLayer:
        """Return the cheapest nodes: at most `kept_nodes`, and at most `kept_per_wide_cell` in each wide cell."""
        order = np.argsort(nodes.cost_m, kind="stable")
        cells = compute_cell_numbers(
            nodes.x_m[order], nodes.y_m[order], nodes.heading_rad[order], WIDE_CELL_M, WIDE_CELL_RAD
        )
        is_kept = count_earlier_in_cell(cells) < self._parameters.kept_per_wide_cell
        return nodes.select_rows(order[is_kept][: self._parameters.kept_nodes])
