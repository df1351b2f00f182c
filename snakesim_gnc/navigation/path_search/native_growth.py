"""Grows the paths of a beam search in C, with the results of `specified_growth` to the last bit.

The C functions trust the sizes, so this module checks every array before it passes an address. All memory belongs to
this module; the C functions allocate none.
"""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search import margin, search_parameters
from snakesim_gnc.navigation.path_search.native_library import (
    INTEGER,
    NO_LAYER_ROOM,
    NODE,
    NUMBER,
    NativeGrowthError,
    NativeLayout,
    NativeMemory,
    NativeSearch,
    explain_absence,
    load_library,
)
from snakesim_gnc.navigation.path_search.path_growth import PathGrowth
from snakesim_gnc.navigation.path_search.search_arcs import ArcTable
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer
from snakesim_gnc.navigation.path_search.search_parameters import STEP_M, SearchParameters, count_body_arcs
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask

Array = NDArray[Any]


class NativeGrowth(PathGrowth):
    """Grows paths with the C library.

    Raises:
        NativeGrowthError: by the constructor, if the C library is not installed or an array has a wrong size; by
            `grow`, if there are as many layers as were requested.
    """

    def __init__(
        self, obstacles: ObstacleGrid, parameters: SearchParameters, task: SearchTask, start: NodeLayer, steps: int
    ) -> None:
        """Copy a search into the structures of the C library, which then expands it layer by layer.

        Args:
            obstacles: the map.
            parameters: the robot, and the cost weights.
            task: goal of the search, and the body from which it starts.
            start: nodes of the first layer.
            steps: maximum number of layers after the first.

        Raises:
            NativeGrowthError: the C library is not installed.
        """
        library = load_library()
        if library is None:
            raise NativeGrowthError(f"there is no C library of the planner: {explain_absence()}")
        self._expand = library.expand
        self._node_room = max(parameters.kept_nodes, len(start.x_m))
        self._layer_room = steps + 1
        self._memory = NativeMemory()

        self._search = NativeSearch()
        self._search.grid = obstacles.make_native_grid(self._memory)
        self._fill_arc_table(ArcTable(parameters))
        self._fill_parameters(parameters)
        self._fill_task(task, parameters)
        self._fill_layers(start)
        self._fill_scratch(library.layout, len(parameters.curvatures_per_m))

    @property
    def node_count(self) -> int:
        return self._search.layers.node_count

    def grow(self) -> bool:
        added = self._expand(ctypes.byref(self._search))
        if added == NO_LAYER_ROOM:
            raise NativeGrowthError(f"the paths have {self._layer_room - 1} arcs already, as many as were asked for")
        return added > 0

    def trace_cheapest(self) -> SearchedPath | None:
        layers = self._search.layers
        if layers.layer_count == 1:
            return None
        newest = self._node_pair[(layers.layer_count - 1) % 2]["cost_m"][: layers.node_count]
        row = int(np.argmin(newest))
        cost_m = float(newest[row])
        points: list[tuple[float, float]] = []
        margins: list[float] = []
        for layer in reversed(range(layers.layer_count)):
            points.append((self._x_m[layer, row], self._y_m[layer, row]))
            margins.append(self._margin_n[layer, row])
            row = int(self._parent[layer, row])
        return SearchedPath(np.array(points[::-1]), np.array(margins[::-1]), cost_m)

    def _fill_arc_table(self, arcs: ArcTable) -> None:
        table = self._search.arc_table
        curvatures_per_m = arcs.curvatures_per_m
        shape = (len(curvatures_per_m),)
        table.count = len(curvatures_per_m)
        table.curvature_per_m = self._memory.pass_array("the curvatures", curvatures_per_m, shape)
        table.turn_rad = self._memory.pass_array("the turns", curvatures_per_m * STEP_M, shape)
        table.half_turn_rad = self._memory.pass_array("the half turns", 0.5 * curvatures_per_m * STEP_M, shape)
        table.end_ahead_m = self._memory.pass_array("the ends of the arcs", arcs.end_m[0], shape)
        table.end_left_m = self._memory.pass_array("the ends of the arcs", arcs.end_m[1], shape)
        table.middle_ahead_m = self._memory.pass_array("the middles of the arcs", arcs.middle_m[0], shape)
        table.middle_left_m = self._memory.pass_array("the middles of the arcs", arcs.middle_m[1], shape)
        table.needed_inside_m = self._memory.pass_array("the needed distances", arcs.needed_inside_m, shape)
        table.surely_clear_m = self._memory.pass_array("the clear distances", arcs.surely_clear_m, shape)
        table.needed_m = arcs.needed_m
        table.surely_blocked_m = arcs.surely_blocked_m

    def _fill_parameters(self, parameters: SearchParameters) -> None:
        """Copy the robot, the cost weights and the constants of the search into the structure that C reads.

        Args:
            parameters: parameters of the search.
        """
        native = self._search.parameters
        # The robot.
        native.step_m = STEP_M
        native.body_length_m = parameters.body_length_m
        native.body_arcs = count_body_arcs(parameters)
        native.radius_m = parameters.radius_m
        native.contact_distance_m = parameters.contact_distance_m
        native.max_frontal = search_parameters.MAX_FRONTAL
        native.min_push = search_parameters.MIN_PUSH
        native.obstacle_friction = parameters.assumed_obstacle_friction
        native.max_heading_error_rad = search_parameters.MAX_HEADING_ERROR_RAD
        # Costs; the products are those that `specified_growth` computes first.
        native.push_reward = parameters.push_reward
        native.push_reward_of_body = parameters.push_reward_of_body
        native.brake_cost = parameters.brake_cost
        native.progress_reward = parameters.progress_reward
        native.curvature_change_cost_m2 = parameters.curvature_change_cost_m * STEP_M
        native.weak_margin_cost_m = STEP_M * parameters.weak_margin_cost
        native.weak_margin_cost_near_m = STEP_M * parameters.weak_margin_cost_near
        native.near_m = parameters.near_m
        native.failed_path_cost_m = STEP_M * parameters.failed_path_cost
        native.failed_path_m = search_parameters.FAILED_PATH_M
        native.sideways_cost_m = STEP_M * parameters.sideways_cost
        # The propulsion margin.
        native.unused_tail_m = parameters.unused_tail_m
        native.unused_head_m = parameters.unused_head_m
        native.wanted_margin_n = parameters.wanted_margin_n
        native.max_contact_force_n = margin.MAX_CONTACT_FORCE_N
        native.min_determinant = margin.MIN_DETERMINANT
        native.moment_scale = margin.WRENCH_SCALE[2]
        native.min_force_per_n = margin.MIN_FORCE_PER_N
        # Nodes that are kept.
        native.cell_m = search_parameters.CELL_M
        native.cell_rad = search_parameters.CELL_RAD
        native.wide_cell_m = search_parameters.WIDE_CELL_M
        native.wide_cell_rad = search_parameters.WIDE_CELL_RAD
        native.max_candidates = search_parameters.CANDIDATES_PER_KEPT_NODE * parameters.kept_nodes
        native.kept_nodes = parameters.kept_nodes
        native.kept_per_wide_cell = parameters.kept_per_wide_cell

    def _fill_task(self, task: SearchTask, parameters: SearchParameters) -> None:
        """Copy the goal of the search and the body from which it starts into the structure that C reads.

        Args:
            task: the task of the search.
            parameters: the robot, whose length gives the number of arcs of the body.
        """
        native = self._search.task
        native.origin_x_m, native.origin_y_m = task.origin_w
        native.goal_rad = task.goal_rad
        native.goal_x, native.goal_y = task.goal_w
        body_arcs = count_body_arcs(parameters)
        native.lying_drag_m = self._memory.pass_array("the drag of the lying body", task.initial_drag_m, (body_arcs, 3))
        native.is_relaid = task.initial_body_w is not None
        if task.initial_body_w is not None:
            native.lying_count = len(task.initial_body_w)
            native.lying_m = self._memory.pass_array("the lying body", task.initial_body_w, (body_arcs + 1, 2))
        native.max_sideways_m = task.max_sideways_m
        if task.failed_w is not None:
            native.failed_count = len(task.failed_w)
            native.failed_m = self._memory.pass_array("the failed paths", task.failed_w, (len(task.failed_w), 2))

    def _fill_layers(self, start: NodeLayer) -> None:
        """Allocate the layers of the search for C, and copy the nodes of the first layer into them.

        Of all layers, parents, positions, margins and drag are kept, so that a path can be traced back. Complete nodes
        are kept for two layers, which C reads and writes by turns.

        Args:
            start: nodes of the first layer.
        """
        count = len(start.x_m)
        history = (self._layer_room, self._node_room)
        self._parent = np.empty(history, dtype=INTEGER)
        self._x_m = np.empty(history)
        self._y_m = np.empty(history)
        self._margin_n = np.empty(history)
        arc_drag_m = np.empty((*history, 3))
        self._parent[0, :count] = start.parent
        self._x_m[0, :count] = start.x_m
        self._y_m[0, :count] = start.y_m
        self._margin_n[0, :count] = start.margin_n
        arc_drag_m[0, :count] = start.arc_drag_m

        # Layers with even numbers are in the first array, the others in the second.
        self._node_pair = (_make_nodes(start, self._node_room), np.empty(self._node_room, dtype=NODE))

        layers = self._search.layers
        layers.layer_count = 1
        layers.layer_room = self._layer_room
        layers.node_room = self._node_room
        layers.node_count = count
        layers.s_m = start.s_m
        layers.parents = self._memory.pass_array("the parents", self._node_pair[0], (self._node_room,), NODE)
        layers.children = self._memory.pass_array("the children", self._node_pair[1], (self._node_room,), NODE)
        layers.parent = self._memory.pass_array("the rows of the parents", self._parent, history, INTEGER)
        layers.x_m = self._memory.pass_array("the history of x", self._x_m, history)
        layers.y_m = self._memory.pass_array("the history of y", self._y_m, history)
        layers.margin_n = self._memory.pass_array("the history of margins", self._margin_n, history)
        layers.arc_drag_m = self._memory.pass_array("the history of drag", arc_drag_m, (*history, 3))

    def _fill_scratch(self, layout: NativeLayout, curvature_count: int) -> None:
        scratch = self._search.scratch
        arc_room = self._node_room * curvature_count
        entry_room = 1 << (arc_room * 5 // 4).bit_length()  # a power of two; the table is at most 80 % full
        scratch.entry_room = entry_room
        scratch.stamp = 0
        scratch.arcs = self._memory.provide(arc_room * layout.arc)
        scratch.keys = self._memory.provide(arc_room * layout.sort_key)
        scratch.spare_keys = self._memory.provide(arc_room * layout.sort_key)
        scratch.candidates = self._memory.provide(arc_room * layout.candidate)
        scratch.entries = self._memory.provide(entry_room * layout.cell_entry)
        scratch.tail_nodes = self._memory.provide(self._node_room * INTEGER.itemsize)
        scratch.near_failed_m = self._memory.provide(max(self._search.task.failed_count, 1) * 2 * NUMBER.itemsize)


def _make_nodes(layer: NodeLayer, room: int) -> Array:
    """Return the nodes of a layer, in an array with room for more."""
    count = len(layer.x_m)
    nodes = np.zeros(room, dtype=NODE)
    used = nodes[:count]
    used["x_m"] = layer.x_m
    used["y_m"] = layer.y_m
    used["heading_rad"] = layer.heading_rad
    used["curvature_per_m"] = layer.curvature_per_m
    used["cost_m"] = layer.cost_m
    used["drag_m"] = layer.drag_m
    used["contacts"]["obstacle"] = layer.obstacle
    used["contacts"]["s_m"] = layer.contact_s_m
    used["contacts"]["gap_m"] = layer.contact_gap_m
    used["contacts"]["wrench"] = layer.contact_wrench
    return nodes
