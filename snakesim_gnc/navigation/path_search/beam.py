"""A beam search for a path ahead of the head. Pure.

The search grows paths in layers of short arcs. It expands all nodes of a layer at once, with every allowed curvature,
and keeps the best few. Each node has the propulsion margin of the whole body with its head there (`search_nodes`).
`specified_growth` specifies how a layer is expanded; `native_growth` does the same in C where its library is installed.

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

from collections.abc import Generator

import numpy as np

from snakesim_gnc.geometry.planar import compute_wrenches, sample_back_from_end
from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.body_contacts import (
    compute_node_margins_n,
    find_obstacle_contacts,
)
from snakesim_gnc.navigation.path_search.native_growth import NativeExpander
from snakesim_gnc.navigation.path_search.native_library import is_native_available
from snakesim_gnc.navigation.path_search.path_growth import PathExpander
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer, make_start_nodes
from snakesim_gnc.navigation.path_search.search_parameters import (
    STEP_M,
    SearchParameters,
    count_arcs_per_body,
)
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask
from snakesim_gnc.navigation.path_search.specified_growth import NumpyExpander
from snakesim_hal.base.arrays import Floats

# Where the search of a whole body begins: around the tail, and around its heading.
TAIL_OFFSETS_M = (-0.03, 0.0, 0.03)  # to the left
TAIL_TURNS_RAD = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])

# Yields the nodes of each step; returns None without a path.
PathSearchSteps = Generator[int, None, SearchedPath | None]


class BeamSearch:
    """Searches paths from a body's head, or for the whole body, towards a direction."""

    def __init__(
        self,
        obstacles: ObstacleGrid,
        parameters: SearchParameters,
        expander_class: type[PathExpander] | None = None,
    ) -> None:
        """Prepare to search paths on a map, from the head of a body or for the whole body.

        Args:
            obstacles: The map.
            parameters: Size of the robot's body, and the cost weights.
            expander_class: Implementation that expands the layers of the search. None selects the C library if it is
                installed, and NumPy otherwise. The paths are the same.
        """
        self._obstacles = obstacles
        self._parameters = parameters
        self._arcs_per_body = count_arcs_per_body(parameters)
        if expander_class is None:
            expander_class = NativeExpander if is_native_available() else NumpyExpander
        self._expander_class = expander_class

    def search_ahead(
        self, body_w: Floats, travel_direction_rad: float, arc_count: int
    ) -> PathSearchSteps:
        """Search the best path ahead of the head.

        Args:
            body_w: (n, 2) points of the body's curve in the world, tail to head.
            travel_direction_rad: Direction of travel in the world frame.
            arc_count: Number of arcs (path segments of STEP_M) of the path.

        Yields:
            The number of expanded nodes of each step, so that a caller can spread the search over several ticks.

        Returns:
            A path of that many arcs, or of as many as there is room for; None if there is no room for one.
        """
        initial_body_w = sample_back_from_end(body_w, STEP_M, self._arcs_per_body)
        origin_w = body_w[-1]
        midpoints_w, tangents = _compute_chord_midpoints_and_tangents(initial_body_w)
        task = SearchTask(
            origin_w=origin_w,
            travel_direction_rad=travel_direction_rad,
            travel_direction_w=np.array(
                [np.cos(travel_direction_rad), np.sin(travel_direction_rad)]
            ),
            # Integral of the wrench of the unit tangent over each arc of the body.
            initial_drag_m=STEP_M * compute_wrenches(midpoints_w - origin_w, tangents),
        )
        start = self._make_start_node_at_head(body_w, midpoints_w, tangents, task)
        return (yield from self._expand_layers(start, arc_count, task))

    def search_whole_body(
        self,
        body_w: Floats,
        travel_direction_rad: float,
        arc_count: int,
        max_sideways_m: float,
        failed_w: Floats | None = None,
    ) -> PathSearchSteps:
        """Search the best path for the whole body, which begins at the tail, and beyond the head.

        Args:
            body_w: (n, 2) points of the body's curve in the world, tail to head, m.
            travel_direction_rad: Direction of travel in the world frame.
            arc_count: Number of arcs beyond the head.
            max_sideways_m: Maximum distance of the path from the current body.
            failed_w: (k, 2) points of paths on which the body got stuck here, m; the search prefers other ways round.

        Yields:
            The number of expanded nodes of each step.

        Returns:
            A path, which may have fewer arcs; None if there is none.
        """
        initial_body_w = sample_back_from_end(body_w, STEP_M, self._arcs_per_body)
        task = SearchTask(
            origin_w=body_w[-1],
            travel_direction_rad=travel_direction_rad,
            travel_direction_w=np.array(
                [np.cos(travel_direction_rad), np.sin(travel_direction_rad)]
            ),
            initial_drag_m=np.zeros((self._arcs_per_body, 3)),
            initial_body_w=initial_body_w,
            max_sideways_m=max_sideways_m,
            failed_w=failed_w,
        )
        return (
            yield from self._expand_layers(
                _make_start_nodes_at_tail(initial_body_w), self._arcs_per_body + arc_count, task
            )
        )

    def _expand_layers(self, start: NodeLayer, arc_count: int, task: SearchTask) -> PathSearchSteps:
        """Expand a number of layers of the search, and return the cheapest path.

        Args:
            start: Nodes of the first layer.
            arc_count: Maximum number of arcs of the path.
            task: Goal of the search, and the body from which it starts.

        Yields:
            The number of nodes that the next step expands, before doing it.

        Returns:
            The cheapest path, or None if no arc is free.
        """
        expander = self._expander_class(self._obstacles, self._parameters, task, start, arc_count)
        for _ in range(arc_count):
            yield expander.node_count
            if not expander.expand_layer():
                break
        return expander.trace_cheapest()

    def _make_start_node_at_head(
        self, body_w: Floats, middles_w: Floats, tangents: Floats, task: SearchTask
    ) -> NodeLayer:
        """Make the start node of a search ahead of the head: the body as it lies, with its contacts and drag.

        Args:
            body_w: (n, 2) the body's curve, tail to head, m.
            middles_w: (a, 2) middles of the a arcs of the body, m.
            tangents: (a, 2) unit vectors along these arcs.
            task: Goal of the search, and drag of the body.
        """
        ahead = body_w[-1:] - body_w[-2:-1]
        node = make_start_nodes(body_w[-1:], np.arctan2(ahead[:, 1], ahead[:, 0]))
        node.drag_m = task.initial_drag_m.sum(axis=0)[None]
        contacts = find_obstacle_contacts(
            self._obstacles, middles_w, tangents, self._parameters, task
        )
        for arc in np.flatnonzero(contacts.is_usable):
            s_m = -STEP_M * (self._arcs_per_body - int(arc) - 0.5)
            row = slice(arc, arc + 1)
            node.add_contacts(
                contacts.is_usable[row],
                contacts.obstacle[row],
                contacts.gap_m[row],
                contacts.wrench[row],
                s_m,
            )
        node.propulsion_margin_n = compute_node_margins_n(node, self._parameters)
        return node


def _compute_chord_midpoints_and_tangents(points_w: Floats) -> tuple[Floats, Floats]:
    """Return the middles (k, 2) and the unit vectors (k, 2) of the k chords between successive points (k + 1, 2)."""
    chords = np.diff(points_w, axis=0)
    lengths_m = np.maximum(np.hypot(chords[:, 0], chords[:, 1]), 1e-9)
    return 0.5 * (points_w[1:] + points_w[:-1]), chords / lengths_m[:, None]


def _make_start_nodes_at_tail(initial_body_w: Floats) -> NodeLayer:
    """Make the start nodes of a search for the whole body: positions and headings around its tail end.

    Args:
        initial_body_w: (a + 1, 2) points of the body as it lies, tail to head, m.
    """
    tail_w = initial_body_w[0]
    ahead = initial_body_w[1] - tail_w
    heading_rad = float(np.arctan2(ahead[1], ahead[0]))
    left = np.array([-np.sin(heading_rad), np.cos(heading_rad)])
    turn_count = len(TAIL_TURNS_RAD)
    points_w = np.concatenate(
        [np.tile(tail_w + offset_m * left, (turn_count, 1)) for offset_m in TAIL_OFFSETS_M]
    )
    return make_start_nodes(points_w, np.tile(heading_rad + TAIL_TURNS_RAD, len(TAIL_OFFSETS_M)))
