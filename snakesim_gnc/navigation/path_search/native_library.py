"""The C library of the path search: how it lays out its data, and how it is loaded.

The structures are those of `snakesim_native/planner/search.h`, whose fields are explained there.
"""

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.path_search.search_parameters import MAX_CONTACTS
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


class NativeMemory:
    """Arrays whose addresses C functions have. They stay alive as long as this object."""

    def __init__(self) -> None:
        self._arrays: list[Array] = []

    def pass_array(self, name: str, array: Array, shape: tuple[int, ...], dtype: np.dtype[Any] = NUMBER) -> int:
        """Return the address of an array that C functions may read and write.

        Args:
            name: of the array, for the error.
            array: the values. They are copied if they are not contiguous or have another type.
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

    def provide(self, size_bytes: int) -> int:
        """Return the address of new memory, which is zero."""
        memory = np.zeros(-(-size_bytes // NUMBER.itemsize))
        self._arrays.append(memory)
        return memory.ctypes.data


class NativeWindow(ctypes.Structure):
    """A rectangle of cells; the last ones are not in it."""

    _fields_ = _integers("first_column", "last_column", "first_row", "last_row")


class NativeGrid(ctypes.Structure):
    """The obstacles, and the grid of their nearest ones."""

    _fields_ = [
        *_numbers("low_x_m", "low_y_m", "cell_m", "cell_error_m", "max_distance_m"),
        *_integers("columns", "rows"),
        *_addresses("nearest", "distance_m", "center_m", "direction", "half_size_m", "rounding_m"),
    ]


class NativeArcTable(ctypes.Structure):
    """The arcs of all curvatures."""

    _fields_ = [
        *_integers("count"),
        *_addresses("curvature_per_m", "turn_rad", "half_turn_rad"),
        *_addresses("end_ahead_m", "end_left_m", "middle_ahead_m", "middle_left_m"),
        *_addresses("needed_inside_m", "surely_clear_m"),
        *_numbers("needed_m", "surely_blocked_m"),
    ]


class NativeParameters(ctypes.Structure):
    """The robot and the costs."""

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


class NativeTask(ctypes.Structure):
    """The goal of one search, and the body from which it starts."""

    _fields_ = [
        *_numbers("origin_x_m", "origin_y_m", "goal_rad", "goal_x", "goal_y"),
        *_addresses("lying_drag_m"),
        *_integers("is_relaid", "lying_count"),
        *_addresses("lying_m"),
        *_numbers("max_sideways_m"),
        *_integers("failed_count"),
        *_addresses("failed_m"),
    ]


class NativeLayers(ctypes.Structure):
    """The layers of the search."""

    _fields_ = [
        *_integers("layer_count", "layer_room", "node_room", "node_count"),
        *_numbers("s_m"),
        *_addresses("parents", "children"),
        *_addresses("parent", "x_m", "y_m", "margin_n", "arc_drag_m"),
    ]


class NativeScratch(ctypes.Structure):
    """Memory for the work on one layer."""

    _fields_ = [
        *_integers("entry_room"),
        ("stamp", ctypes.c_int32),
        *_addresses("arcs", "keys", "spare_keys", "candidates", "entries", "tail_nodes", "near_failed_m"),
    ]


class NativeSearch(ctypes.Structure):
    """Everything about one search."""

    _fields_ = [
        ("grid", NativeGrid),
        ("arc_table", NativeArcTable),
        ("parameters", NativeParameters),
        ("task", NativeTask),
        ("layers", NativeLayers),
        ("scratch", NativeScratch),
    ]


class NativeLayout(ctypes.Structure):
    """The sizes of the structures in bytes."""

    _fields_ = _integers("search", "node", "contact", "arc", "sort_key", "candidate", "cell_entry")


@dataclass(frozen=True)
class PlannerLibrary:
    """The functions of the C library, and the sizes of its structures in bytes."""

    expand: Any  # int64 expand(Search*)
    mark_obstacle: Any  # void mark_obstacle(const Grid*, const Window*, int64 obstacle)
    layout: NativeLayout


@cache
def load_library() -> PlannerLibrary | None:
    """Load the planner's C library, and check that it was compiled for the structures of this version.

    Returns:
        Its functions, or None if the library is not installed here.

    Raises:
        NativeGrowthError: its structures have other sizes than those of this module.
    """
    handle = load(PLANNER).handle
    if handle is None:
        return None
    layout = NativeLayout()
    handle.snakesim_planner_layout.restype = None
    handle.snakesim_planner_layout.argtypes = [ctypes.POINTER(NativeLayout)]
    handle.snakesim_planner_layout(ctypes.byref(layout))
    python_sizes = (ctypes.sizeof(NativeSearch), NODE.itemsize, CONTACT.itemsize)
    library_sizes = (layout.search, layout.node, layout.contact)
    if python_sizes != library_sizes:
        raise NativeGrowthError(
            f"search, node and contact have {library_sizes} bytes in the C library, and {python_sizes} in Python"
        )
    expand = handle.snakesim_planner_expand
    expand.restype = ctypes.c_int64
    expand.argtypes = [ctypes.POINTER(NativeSearch)]
    mark_obstacle = handle.snakesim_planner_mark_obstacle
    mark_obstacle.restype = None
    mark_obstacle.argtypes = [ctypes.POINTER(NativeGrid), ctypes.POINTER(NativeWindow), ctypes.c_int64]
    return PlannerLibrary(expand, mark_obstacle, layout)


def is_native_available() -> bool:
    """Return whether the C library can be loaded here."""
    return load_library() is not None


def explain_absence() -> str:
    """Return why the C library is not installed here; empty if it is."""
    return load(PLANNER).problem
