"""Grows the paths of a beam search in C, with the results of `path_growth` to the last bit.

The structures and arrays here are laid out as in `snakesim_native/planner/search.h`, whose fields are explained there.
The C functions trust the sizes, so this module checks every array before it passes an address. All memory belongs to
this module; the C functions allocate none.
"""

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation import margin, obstacle_grid, path_growth
from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_growth import SearchedPath, SearchTask, count_body_arcs
from snakesim_gnc.navigation.search_arcs import STEP_M, ArcTable
from snakesim_gnc.navigation.search_nodes import MAX_CONTACTS, NodeLayer
from snakesim_gnc.navigation.search_parameters import SearchParameters
from snakesim_native.libraries import PLANNER
from snakesim_native.load import load

Array = NDArray[Any]

INTEGER = np.dtype(np.int64)
NUMBER = np.dtype(np.float64)
CONTACT = np.dtype([("obstacle", INTEGER), ("s_m", NUMBER), ("gap_m", NUMBER), ("wrench", NUMBER, 3)])
NODE = np.dtype(
    [
        ("x_m", NUMBER),
        ("y_m", NUMBER),
        ("heading_rad", NUMBER),
        ("curvature_per_m", NUMBER),
        ("cost_m", NUMBER),
        ("drag_m", NUMBER, 3),
        ("contacts", CONTACT, MAX_CONTACTS),
    ]
)
NO_LAYER_ROOM = -1  # what `snakesim_planner_expand` returns then


class NativeGrowthError(Exception):
    """The C library and this module do not fit each other, or an array has a wrong size."""


def _numbers(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_double) for name in names]


def _integers(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_int64) for name in names]


def _addresses(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_void_p) for name in names]


class _Grid(ctypes.Structure):
    _fields_ = [
        *_numbers("low_x_m", "low_y_m", "cell_m", "cell_error_m", "max_distance_m"),
        *_integers("columns", "rows"),
        *_addresses("nearest", "distance_m", "center_m", "direction", "half_size_m", "rounding_m"),
    ]


class _ArcTable(ctypes.Structure):
    _fields_ = [
        *_integers("count"),
        *_addresses("curvature_per_m", "turn_rad", "half_turn_rad"),
        *_addresses("end_ahead_m", "end_left_m", "middle_ahead_m", "middle_left_m"),
        *_addresses("needed_inside_m", "surely_clear_m"),
        *_numbers("needed_m", "surely_blocked_m"),
    ]


class _Parameters(ctypes.Structure):
    _fields_ = [
        *_numbers("step_m", "body_length_m", "radius_m", "contact_distance_m", "max_frontal", "min_push"),
        *_numbers("obstacle_friction", "unused_tail_m", "unused_head_m", "wanted_margin_n"),
        *_numbers("max_heading_error_rad", "near_m"),
        *_numbers("push_reward", "push_reward_of_body", "brake_cost", "progress_reward", "curvature_change_cost_m2"),
        *_numbers("weak_margin_cost_m", "weak_margin_cost_near_m", "failed_path_cost_m", "sideways_cost_m"),
        *_numbers("failed_path_m"),
        *_numbers("max_contact_force_n", "min_determinant", "moment_scale", "min_force_per_n"),
        *_numbers("cell_m", "cell_rad", "wide_cell_m", "wide_cell_rad"),
        *_integers("max_candidates", "kept_nodes", "kept_per_wide_cell", "body_arcs"),
    ]


class _Task(ctypes.Structure):
    _fields_ = [
        *_numbers("origin_x_m", "origin_y_m", "goal_rad", "goal_x", "goal_y"),
        *_addresses("lying_drag_m"),
        *_integers("is_relaid", "lying_count"),
        *_addresses("lying_m"),
        *_numbers("max_sideways_m"),
        *_integers("failed_count"),
        *_addresses("failed_m"),
    ]


class _Layers(ctypes.Structure):
    _fields_ = [
        *_integers("layer_count", "layer_room", "node_room", "node_count"),
        *_numbers("s_m"),
        *_addresses("parents", "children"),
        *_addresses("parent", "x_m", "y_m", "margin_n", "arc_drag_m"),
    ]


class _Scratch(ctypes.Structure):
    _fields_ = [
        *_integers("entry_room"),
        ("stamp", ctypes.c_int32),
        *_addresses("arcs", "keys", "spare_keys", "candidates", "entries", "tail_nodes", "near_failed_m"),
    ]


class _Search(ctypes.Structure):
    _fields_ = [
        ("grid", _Grid),
        ("arc_table", _ArcTable),
        ("parameters", _Parameters),
        ("task", _Task),
        ("layers", _Layers),
        ("scratch", _Scratch),
    ]


class _Layout(ctypes.Structure):
    _fields_ = _integers("search", "node", "contact", "arc", "sort_key", "candidate", "cell_entry")


@dataclass(frozen=True)
class _Library:
    """The functions of the C library, and the sizes of its structures in bytes."""

    expand: Any  # int64 expand(Search*)
    layout: _Layout


@cache
def load_library() -> _Library | None:
    """Return the C library; None if it is not installed here.

    Raises:
        NativeGrowthError: its structures have other sizes than those of this module.
    """
    handle = load(PLANNER).handle
    if handle is None:
        return None
    layout = _Layout()
    handle.snakesim_planner_layout.restype = None
    handle.snakesim_planner_layout.argtypes = [ctypes.POINTER(_Layout)]
    handle.snakesim_planner_layout(ctypes.byref(layout))
    here = (ctypes.sizeof(_Search), NODE.itemsize, CONTACT.itemsize)
    there = (layout.search, layout.node, layout.contact)
    if here != there:
        raise NativeGrowthError(f"search, node and contact have {there} bytes in the C library, and {here} in Python")
    expand = handle.snakesim_planner_expand
    expand.restype = ctypes.c_int64
    expand.argtypes = [ctypes.POINTER(_Search)]
    return _Library(expand, layout)


def is_native_available() -> bool:
    """Return whether the C library can be loaded here."""
    return load_library() is not None


class NativeGrowth:
    """Grows paths with the C library."""

    def __init__(
        self, obstacles: ObstacleGrid, parameters: SearchParameters, task: SearchTask, start: NodeLayer, steps: int
    ) -> None:
        """Begin with the start nodes as the first layer.

        Args:
            obstacles: the map.
            parameters: the robot, and the costs.
            task: the search.
            start: the nodes from which the paths grow.
            steps: the largest number of arcs.

        Raises:
            NativeGrowthError: the C library is not installed, or an array has another size than it must have.
        """
        library = load_library()
        if library is None:
            raise NativeGrowthError(f"there is no C library of the planner: {load(PLANNER).problem}")
        self._expand = library.expand
        self._node_room = max(parameters.kept_nodes, len(start.x_m))
        self._layer_room = steps + 1
        self._arrays: list[Array] = []  # keeps the memory alive, as the structures hold only addresses

        self._search = _Search()
        self._fill_grid(obstacles)
        self._fill_arc_table(ArcTable(parameters))
        self._fill_parameters(parameters)
        self._fill_task(task, parameters)
        self._fill_layers(start)
        self._fill_scratch(library.layout, len(parameters.curvatures_per_m))

    @property
    def node_count(self) -> int:
        """Return the number of nodes in the newest layer."""
        return self._search.layers.node_count

    def grow(self) -> bool:
        """Add the best children of the newest layer. Return False if none is free.

        Raises:
            NativeGrowthError: there are as many layers as were asked for already.
        """
        added = self._expand(ctypes.byref(self._search))
        if added == NO_LAYER_ROOM:
            raise NativeGrowthError(f"the paths have {self._layer_room - 1} arcs already, as many as were asked for")
        return added > 0

    def trace_cheapest(self) -> SearchedPath | None:
        """Follow the parents of the cheapest node of the newest layer back to the start."""
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

    def _pass(self, name: str, array: Array, shape: tuple[int, ...], dtype: np.dtype[Any] = NUMBER) -> int:
        """Return the address of an array, which stays alive as long as this object.

        Args:
            name: of the array, for the error.
            array: the values; they are copied if they are not contiguous or have another type.
            shape: that the C functions expect.
            dtype: that they expect.

        Raises:
            NativeGrowthError: the array has another shape.
        """
        if array.shape != shape:
            raise NativeGrowthError(f"{name} has the shape {array.shape}, the C library of the planner expects {shape}")
        contiguous = np.ascontiguousarray(array, dtype=dtype)
        self._arrays.append(contiguous)
        return contiguous.ctypes.data

    def _fill_grid(self, obstacles: ObstacleGrid) -> None:
        grid = self._search.grid
        outlines = obstacles.outlines
        count = len(outlines)
        grid.low_x_m, grid.low_y_m = obstacles.low_w
        grid.columns, grid.rows = obstacles.shape
        grid.cell_m = obstacle_grid.CELL_M
        grid.cell_error_m = obstacle_grid.CELL_ERROR_M
        grid.max_distance_m = obstacle_grid.MAX_DISTANCE_M
        cells = (grid.columns * grid.rows,)
        grid.nearest = self._pass("the nearest obstacle of each cell", obstacles.cell_nearest, cells, INTEGER)
        grid.distance_m = self._pass("the distance of each cell", obstacles.cell_distance_m, cells)
        grid.center_m = self._pass("the centers of the obstacles", outlines.center_w, (count, 2))
        grid.direction = self._pass("the directions of the obstacles", outlines.direction, (count, 2))
        grid.half_size_m = self._pass("the half sizes of the obstacles", outlines.half_m, (count, 2))
        grid.rounding_m = self._pass("the roundings of the obstacles", outlines.rounding_m, (count,))

    def _fill_arc_table(self, arcs: ArcTable) -> None:
        table = self._search.arc_table
        curvatures_per_m = arcs.curvatures_per_m
        shape = (len(curvatures_per_m),)
        table.count = len(curvatures_per_m)
        table.curvature_per_m = self._pass("the curvatures", curvatures_per_m, shape)
        table.turn_rad = self._pass("the turns", curvatures_per_m * STEP_M, shape)
        table.half_turn_rad = self._pass("the half turns", 0.5 * curvatures_per_m * STEP_M, shape)
        table.end_ahead_m = self._pass("the ends of the arcs", arcs.end_m[0], shape)
        table.end_left_m = self._pass("the ends of the arcs", arcs.end_m[1], shape)
        table.middle_ahead_m = self._pass("the middles of the arcs", arcs.middle_m[0], shape)
        table.middle_left_m = self._pass("the middles of the arcs", arcs.middle_m[1], shape)
        table.needed_inside_m = self._pass("the needed distances", arcs.needed_inside_m, shape)
        table.surely_clear_m = self._pass("the clear distances", arcs.surely_clear_m, shape)
        table.needed_m = arcs.needed_m
        table.surely_blocked_m = arcs.surely_blocked_m

    def _fill_parameters(self, given: SearchParameters) -> None:
        parameters = self._search.parameters
        # The robot.
        parameters.step_m = STEP_M
        parameters.body_length_m = given.body_length_m
        parameters.body_arcs = count_body_arcs(given)
        parameters.radius_m = given.radius_m
        parameters.contact_distance_m = given.contact_distance_m
        parameters.max_frontal = path_growth.MAX_FRONTAL
        parameters.min_push = path_growth.MIN_PUSH
        parameters.obstacle_friction = given.assumed_obstacle_friction
        parameters.max_heading_error_rad = path_growth.MAX_HEADING_ERROR_RAD
        # Costs; the products are those that `path_growth` computes first.
        parameters.push_reward = given.push_reward
        parameters.push_reward_of_body = given.push_reward_of_body
        parameters.brake_cost = given.brake_cost
        parameters.progress_reward = given.progress_reward
        parameters.curvature_change_cost_m2 = given.curvature_change_cost_m * STEP_M
        parameters.weak_margin_cost_m = STEP_M * given.weak_margin_cost
        parameters.weak_margin_cost_near_m = STEP_M * given.weak_margin_cost_near
        parameters.near_m = given.near_m
        parameters.failed_path_cost_m = STEP_M * given.failed_path_cost
        parameters.failed_path_m = path_growth.FAILED_PATH_M
        parameters.sideways_cost_m = STEP_M * given.sideways_cost
        # The propulsion margin.
        parameters.unused_tail_m = given.unused_tail_m
        parameters.unused_head_m = given.unused_head_m
        parameters.wanted_margin_n = given.wanted_margin_n
        parameters.max_contact_force_n = margin.MAX_CONTACT_FORCE_N
        parameters.min_determinant = margin.MIN_DETERMINANT
        parameters.moment_scale = margin.WRENCH_SCALE[2]
        parameters.min_force_per_n = margin.MIN_FORCE_PER_N
        # Nodes that are kept.
        parameters.cell_m = path_growth.CELL_M
        parameters.cell_rad = path_growth.CELL_RAD
        parameters.wide_cell_m = path_growth.WIDE_CELL_M
        parameters.wide_cell_rad = path_growth.WIDE_CELL_RAD
        parameters.max_candidates = path_growth.CANDIDATES_PER_KEPT_NODE * given.kept_nodes
        parameters.kept_nodes = given.kept_nodes
        parameters.kept_per_wide_cell = given.kept_per_wide_cell

    def _fill_task(self, given: SearchTask, parameters: SearchParameters) -> None:
        task = self._search.task
        task.origin_x_m, task.origin_y_m = given.origin_w
        task.goal_rad = given.goal_rad
        task.goal_x, task.goal_y = given.goal_w
        body_arcs = count_body_arcs(parameters)
        task.lying_drag_m = self._pass("the drag of the lying body", given.lying_drag_m, (body_arcs, 3))
        task.is_relaid = given.lying_w is not None
        if given.lying_w is not None:
            task.lying_count = len(given.lying_w)
            task.lying_m = self._pass("the lying body", given.lying_w, (body_arcs + 1, 2))
        task.max_sideways_m = given.max_sideways_m
        if given.failed_w is not None:
            task.failed_count = len(given.failed_w)
            task.failed_m = self._pass("the failed paths", given.failed_w, (len(given.failed_w), 2))

    def _fill_layers(self, start: NodeLayer) -> None:
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
        layers.parents = self._pass("the parents", self._node_pair[0], (self._node_room,), NODE)
        layers.children = self._pass("the children", self._node_pair[1], (self._node_room,), NODE)
        layers.parent = self._pass("the rows of the parents", self._parent, history, INTEGER)
        layers.x_m = self._pass("the history of x", self._x_m, history)
        layers.y_m = self._pass("the history of y", self._y_m, history)
        layers.margin_n = self._pass("the history of margins", self._margin_n, history)
        layers.arc_drag_m = self._pass("the history of drag", arc_drag_m, (*history, 3))

    def _fill_scratch(self, layout: _Layout, curvature_count: int) -> None:
        scratch = self._search.scratch
        arc_room = self._node_room * curvature_count
        entry_room = 1 << (arc_room * 5 // 4).bit_length()  # a power of two; the table is at most 80 % full
        scratch.entry_room = entry_room
        scratch.stamp = 0
        scratch.arcs = self._provide(arc_room * layout.arc)
        scratch.keys = self._provide(arc_room * layout.sort_key)
        scratch.spare_keys = self._provide(arc_room * layout.sort_key)
        scratch.candidates = self._provide(arc_room * layout.candidate)
        scratch.entries = self._provide(entry_room * layout.cell_entry)
        scratch.tail_nodes = self._provide(self._node_room * INTEGER.itemsize)
        scratch.near_failed_m = self._provide(max(self._search.task.failed_count, 1) * 2 * NUMBER.itemsize)

    def _provide(self, size_bytes: int) -> int:
        """Return the address of new memory, which is zero and stays alive as long as this object."""
        memory = np.zeros(-(-size_bytes // NUMBER.itemsize))
        self._arrays.append(memory)
        return memory.ctypes.data


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
