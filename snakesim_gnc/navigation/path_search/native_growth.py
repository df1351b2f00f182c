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
    FLOAT_DTYPE,
    INTEGER_DTYPE,
    LAYER_LIMIT_REACHED,
    NODE_DTYPE,
    NativeLayout,
    NativeMemory,
    NativeSearch,
    PlannerLibraryError,
    explain_missing_library,
    load_library,
)
from snakesim_gnc.navigation.path_search.path_growth import PathExpander
from snakesim_gnc.navigation.path_search.search_arcs import ArcTable
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer
from snakesim_gnc.navigation.path_search.search_parameters import (
    STEP_M,
    SearchParameters,
    count_arcs_per_body,
)
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask

Array = NDArray[Any]


class NativeExpander(PathExpander):
    """Grows paths with the C library.

    Raises:
        PlannerLibraryError: By the constructor, if the C library is not installed or an array has a wrong size; by
            `grow`, if there are as many layers as were requested.
    """

    def __init__(
        self,
        obstacles: ObstacleGrid,
        parameters: SearchParameters,
        task: SearchTask,
        start_nodes: NodeLayer,
        max_arc_count: int,
    ) -> None:
        """Copy a search into the structures of the C library, which then expands it layer by layer.

        Args:
            obstacles: The map.
            parameters: Size of the robot's body, and the cost weights.
            task: Direction of travel, and how the body lies before the search.
            start_nodes: Nodes of the first layer.
            max_arc_count: Maximum number of layers after the first.

        Raises:
            PlannerLibraryError: The C library is not installed.
        """
        library = load_library()
        if library is None:
            raise PlannerLibraryError(
                f"there is no C library of the planner: {explain_missing_library()}"
            )
        self._expand_in_c = library.expand
        self._max_nodes_per_layer = max(parameters.kept_nodes, len(start_nodes.x_m))
        self._max_layers = max_arc_count + 1
        self._memory = NativeMemory()

        self._native_search = NativeSearch()
        self._native_search.grid = obstacles.make_native_grid(self._memory)
        self._fill_arc_table(ArcTable(parameters))
        self._fill_parameters(parameters)
        self._fill_task(task, parameters)
        self._fill_layers(start_nodes)
        self._allocate_scratch_memory(library.layout, len(parameters.curvatures_per_m))

    @property
    def node_count(self) -> int:
        return self._native_search.layers.node_count

    def expand_layer(self) -> bool:
        added_count = self._expand_in_c(ctypes.byref(self._native_search))
        if added_count == LAYER_LIMIT_REACHED:
            raise PlannerLibraryError(
                f"the paths have {self._max_layers - 1} arcs already, as many as were asked for"
            )
        return added_count > 0

    def trace_cheapest(self) -> SearchedPath | None:
        """Follow the parents of the cheapest node of the newest layer back to the start, and return that path."""
        layers = self._native_search.layers
        if layers.layer_count == 1:
            return None
        newest = self._alternating_nodes[(layers.layer_count - 1) % 2]["cost_m"][
            : layers.node_count
        ]
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
        """Copy the table of arcs, which all nodes share, into the structure that C reads."""
        table = self._native_search.arc_table
        curvatures_per_m = arcs.curvatures_per_m
        shape = (len(curvatures_per_m),)
        table.count = len(curvatures_per_m)
        table.curvature_per_m = self._memory.get_array_address(
            "the curvatures", curvatures_per_m, shape
        )
        table.turn_rad = self._memory.get_array_address(
            "the turns", curvatures_per_m * STEP_M, shape
        )
        table.half_turn_rad = self._memory.get_array_address(
            "the half turns", 0.5 * curvatures_per_m * STEP_M, shape
        )
        table.end_ahead_m = self._memory.get_array_address(
            "the ends of the arcs", arcs.end_m[0], shape
        )
        table.end_left_m = self._memory.get_array_address(
            "the ends of the arcs", arcs.end_m[1], shape
        )
        table.middle_ahead_m = self._memory.get_array_address(
            "the middles of the arcs", arcs.middle_m[0], shape
        )
        table.middle_left_m = self._memory.get_array_address(
            "the middles of the arcs", arcs.middle_m[1], shape
        )
        table.needed_inside_m = self._memory.get_array_address(
            "the needed distances", arcs.needed_inside_m, shape
        )
        table.surely_clear_m = self._memory.get_array_address(
            "the clear distances", arcs.surely_clear_m, shape
        )
        table.needed_m = arcs.needed_m
        table.surely_blocked_m = arcs.surely_blocked_m

    def _fill_parameters(self, parameters: SearchParameters) -> None:
        """Copy the robot, the cost weights and the constants of the search into the structure that C reads.

        Args:
            parameters: Parameters of the search.
        """
        native = self._native_search.parameters
        # The robot.
        native.step_m = STEP_M
        native.body_length_m = parameters.body_length_m
        native.body_arcs = count_arcs_per_body(parameters)
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
        """Copy the direction of travel, the body's initial pose and failed paths into the structure that C reads.

        The structure is new, so that all its fields are 0: what is not set here counts as absent. Its addresses stay
        valid as long as `self._memory` lives. The texts name the arrays in errors about their shapes.

        Args:
            task: The task of the search.
            parameters: Length of the body, which gives its number of arcs.
        """
        native = self._native_search.task
        native.origin_x_m, native.origin_y_m = task.origin_w
        native.goal_rad = task.travel_direction_rad
        native.goal_x, native.goal_y = task.travel_direction_w

        # The body as it lies before the search. A search of the whole body may lay it on another path ("relaid").
        body_arc_count = count_arcs_per_body(parameters)
        native.lying_drag_m = self._memory.get_array_address(
            "the drag of the lying body", task.initial_drag_m, (body_arc_count, 3)
        )
        native.is_relaid = task.initial_body_w is not None
        if task.initial_body_w is not None:
            native.lying_count = len(task.initial_body_w)
            native.lying_m = self._memory.get_array_address(
                "the lying body", task.initial_body_w, (body_arc_count + 1, 2)
            )
        native.max_sideways_m = task.max_sideways_m

        # Points of paths on which the body got stuck.
        if task.failed_w is not None:
            native.failed_count = len(task.failed_w)
            native.failed_m = self._memory.get_array_address(
                "the failed paths", task.failed_w, (len(task.failed_w), 2)
            )

    def _fill_layers(self, start_nodes: NodeLayer) -> None:
        """Allocate the layers of the search for C, and copy the nodes of the first layer into them.

        Parents, positions, margins and drag of all layers are kept, so that a path can be traced back. Complete nodes
        are kept for two layers only, which C reads and writes alternately.

        Args:
            start_nodes: Nodes of the first layer.
        """
        start_node_count = len(start_nodes.x_m)
        history_shape = (self._max_layers, self._max_nodes_per_layer)
        self._parent = np.empty(history_shape, dtype=INTEGER_DTYPE)
        self._x_m = np.empty(history_shape)
        self._y_m = np.empty(history_shape)
        self._margin_n = np.empty(history_shape)
        arc_drag_m = np.empty((*history_shape, 3))
        self._parent[0, :start_node_count] = start_nodes.parent_row
        self._x_m[0, :start_node_count] = start_nodes.x_m
        self._y_m[0, :start_node_count] = start_nodes.y_m
        self._margin_n[0, :start_node_count] = start_nodes.propulsion_margin_n
        arc_drag_m[0, :start_node_count] = start_nodes.arc_drag_m

        # Layers with even numbers are in the first array, the others in the second.
        self._alternating_nodes = (
            _make_node_array(start_nodes, self._max_nodes_per_layer),
            np.empty(self._max_nodes_per_layer, dtype=NODE_DTYPE),
        )

        layers = self._native_search.layers
        layers.layer_count = 1
        layers.layer_room = self._max_layers
        layers.node_room = self._max_nodes_per_layer
        layers.node_count = start_node_count
        layers.s_m = start_nodes.path_length_m
        layers.parents = self._memory.get_array_address(
            "the parents", self._alternating_nodes[0], (self._max_nodes_per_layer,), NODE_DTYPE
        )
        layers.children = self._memory.get_array_address(
            "the children", self._alternating_nodes[1], (self._max_nodes_per_layer,), NODE_DTYPE
        )
        layers.parent = self._memory.get_array_address(
            "the rows of the parents", self._parent, history_shape, INTEGER_DTYPE
        )
        layers.x_m = self._memory.get_array_address("the history of x", self._x_m, history_shape)
        layers.y_m = self._memory.get_array_address("the history of y", self._y_m, history_shape)
        layers.margin_n = self._memory.get_array_address(
            "the history of margins", self._margin_n, history_shape
        )
        layers.arc_drag_m = self._memory.get_array_address(
            "the history of drag", arc_drag_m, (*history_shape, 3)
        )

    def _allocate_scratch_memory(self, layout: NativeLayout, curvature_count: int) -> None:
        """Allocate the memory that C needs while it expands a layer: arcs, sort keys and a hash table of cells."""
        scratch = self._native_search.scratch
        max_arcs = self._max_nodes_per_layer * curvature_count
        # A power of two; the table is at most 80 % full.
        entry_room = 1 << (max_arcs * 5 // 4).bit_length()
        scratch.entry_room = entry_room
        scratch.stamp = 0
        scratch.arcs = self._memory.allocate(max_arcs * layout.arc)
        scratch.keys = self._memory.allocate(max_arcs * layout.sort_key)
        scratch.spare_keys = self._memory.allocate(max_arcs * layout.sort_key)
        scratch.candidates = self._memory.allocate(max_arcs * layout.candidate)
        scratch.entries = self._memory.allocate(entry_room * layout.cell_entry)
        scratch.tail_nodes = self._memory.allocate(
            self._max_nodes_per_layer * INTEGER_DTYPE.itemsize
        )
        scratch.near_failed_m = self._memory.allocate(
            max(self._native_search.task.failed_count, 1) * 2 * FLOAT_DTYPE.itemsize
        )


def _make_node_array(layer: NodeLayer, capacity: int) -> Array:
    """Return the nodes of a layer as structures of the C library, in an array with room for more.

    Args:
        layer: Nodes of one depth of the search.
        capacity: Length of the array; the elements after the nodes are zero.
    """
    nodes = np.zeros(capacity, dtype=NODE_DTYPE)
    # A view of the elements that hold a node, so that assignments fill `nodes`.
    used_nodes = nodes[: len(layer.x_m)]
    used_nodes["x_m"] = layer.x_m
    used_nodes["y_m"] = layer.y_m
    used_nodes["heading_rad"] = layer.heading_rad
    used_nodes["curvature_per_m"] = layer.curvature_per_m
    used_nodes["cost_m"] = layer.cost_m
    used_nodes["drag_m"] = layer.drag_m
    used_nodes["contacts"]["obstacle"] = layer.contact_obstacle_index
    used_nodes["contacts"]["s_m"] = layer.contact_arc_length_m
    used_nodes["contacts"]["gap_m"] = layer.contact_gap_m
    used_nodes["contacts"]["wrench"] = layer.contact_wrench
    return nodes
