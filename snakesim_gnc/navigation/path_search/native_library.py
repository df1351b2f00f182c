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
from snakesim_native.libraries import PLANNER_LIBRARY
from snakesim_native.load import load_shared_library

Array = NDArray[Any]

INTEGER_DTYPE = np.dtype(np.int64)
FLOAT_DTYPE = np.dtype(np.float64)
CONTACT_DTYPE = np.dtype(
    [
        ("obstacle", INTEGER_DTYPE),
        ("s_m", FLOAT_DTYPE),
        ("gap_m", FLOAT_DTYPE),
        ("wrench", FLOAT_DTYPE, 3),
    ]
)
NODE_DTYPE = np.dtype(
    [
        ("x_m", FLOAT_DTYPE),
        ("y_m", FLOAT_DTYPE),
        ("heading_rad", FLOAT_DTYPE),
        ("curvature_per_m", FLOAT_DTYPE),
        ("cost_m", FLOAT_DTYPE),
        ("drag_m", FLOAT_DTYPE, 3),
        ("contacts", CONTACT_DTYPE, MAX_CONTACTS),
    ]
)
LAYER_LIMIT_REACHED = -1  # what `snakesim_planner_expand` returns then


class PlannerLibraryError(Exception):
    """The C library and this module do not fit each other, or an array has a wrong size."""


def _make_double_fields(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_double) for name in names]


def _make_integer_fields(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_int64) for name in names]


def _make_pointer_fields(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_void_p) for name in names]


class NativeMemory:
    """Arrays whose addresses C functions have. They stay alive as long as this object."""

    def __init__(self) -> None:
        self._arrays: list[Array] = []

    def get_array_address(
        self, name: str, array: Array, shape: tuple[int, ...], dtype: np.dtype[Any] = FLOAT_DTYPE
    ) -> int:
        """Return the address of an array that C functions may read and write, and keep the array alive.

        Args:
            name: Name of the array, for the error message.
            array: The values. They are copied if they are not contiguous or have another type.
            shape: Shape that the C functions expect.
            dtype: Type that the C functions expect.

        Raises:
            PlannerLibraryError: The array has another shape.
        """
        if array.shape != shape:
            raise PlannerLibraryError(
                f"{name} has the shape {array.shape}, the C library of the planner expects {shape}"
            )
        contiguous_array = np.ascontiguousarray(array, dtype=dtype)
        self._arrays.append(contiguous_array)
        return contiguous_array.ctypes.data

    def allocate(self, size_bytes: int) -> int:
        """Return the address of new memory that is filled with zeros, and keep the memory alive."""
        memory = np.zeros(-(-size_bytes // FLOAT_DTYPE.itemsize))
        self._arrays.append(memory)
        return memory.ctypes.data


class NativeWindow(ctypes.Structure):
    """A rectangle of cells; the last ones are not in it."""

    _fields_ = _make_integer_fields("first_column", "last_column", "first_row", "last_row")


class NativeGrid(ctypes.Structure):
    """The obstacles, and the grid of their nearest ones."""

    _fields_ = [
        *_make_double_fields("low_x_m", "low_y_m", "cell_m", "cell_error_m", "max_distance_m"),
        *_make_integer_fields("columns", "rows"),
        *_make_pointer_fields(
            "nearest", "distance_m", "center_m", "direction", "half_size_m", "rounding_m"
        ),
    ]


class NativeArcTable(ctypes.Structure):
    """The arcs of all curvatures."""

    _fields_ = [
        *_make_integer_fields("count"),
        *_make_pointer_fields("curvature_per_m", "turn_rad", "half_turn_rad"),
        *_make_pointer_fields("end_ahead_m", "end_left_m", "middle_ahead_m", "middle_left_m"),
        *_make_pointer_fields("needed_inside_m", "surely_clear_m"),
        *_make_double_fields("needed_m", "surely_blocked_m"),
    ]


class NativeParameters(ctypes.Structure):
    """The robot and the costs."""

    _fields_ = [
        *_make_double_fields(
            "step_m", "body_length_m", "radius_m", "contact_distance_m", "max_frontal", "min_push"
        ),
        *_make_double_fields(
            "obstacle_friction", "unused_tail_m", "unused_head_m", "wanted_margin_n"
        ),
        *_make_double_fields("max_heading_error_rad", "near_m"),
        *_make_double_fields(
            "push_reward",
            "push_reward_of_body",
            "brake_cost",
            "progress_reward",
            "curvature_change_cost_m2",
        ),
        *_make_double_fields(
            "weak_margin_cost_m", "weak_margin_cost_near_m", "failed_path_cost_m", "sideways_cost_m"
        ),
        *_make_double_fields("failed_path_m"),
        *_make_double_fields(
            "max_contact_force_n", "min_determinant", "moment_scale", "min_force_per_n"
        ),
        *_make_double_fields("cell_m", "cell_rad", "wide_cell_m", "wide_cell_rad"),
        *_make_integer_fields("max_candidates", "kept_nodes", "kept_per_wide_cell", "body_arcs"),
    ]


class NativeTask(ctypes.Structure):
    """The goal of one search, and the body from which it starts."""

    _fields_ = [
        *_make_double_fields("origin_x_m", "origin_y_m", "goal_rad", "goal_x", "goal_y"),
        *_make_pointer_fields("lying_drag_m"),
        *_make_integer_fields("is_relaid", "lying_count"),
        *_make_pointer_fields("lying_m"),
        *_make_double_fields("max_sideways_m"),
        *_make_integer_fields("failed_count"),
        *_make_pointer_fields("failed_m"),
    ]


class NativeLayers(ctypes.Structure):
    """The layers of the search."""

    _fields_ = [
        *_make_integer_fields("layer_count", "layer_room", "node_room", "node_count"),
        *_make_double_fields("s_m"),
        *_make_pointer_fields("parents", "children"),
        *_make_pointer_fields("parent", "x_m", "y_m", "margin_n", "arc_drag_m"),
    ]


class NativeScratch(ctypes.Structure):
    """Memory for the work on one layer."""

    _fields_ = [
        *_make_integer_fields("entry_room"),
        ("stamp", ctypes.c_int32),
        *_make_pointer_fields(
            "arcs", "keys", "spare_keys", "candidates", "entries", "tail_nodes", "near_failed_m"
        ),
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

    _fields_ = _make_integer_fields(
        "search", "node", "contact", "arc", "sort_key", "candidate", "cell_entry"
    )


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
        PlannerLibraryError: Its structures have other sizes than those of this module.
    """
    library = load_shared_library(PLANNER_LIBRARY).library
    if library is None:
        return None
    layout = NativeLayout()
    library.snakesim_planner_layout.restype = None
    library.snakesim_planner_layout.argtypes = [ctypes.POINTER(NativeLayout)]
    library.snakesim_planner_layout(ctypes.byref(layout))
    python_sizes = (ctypes.sizeof(NativeSearch), NODE_DTYPE.itemsize, CONTACT_DTYPE.itemsize)
    library_sizes = (layout.search, layout.node, layout.contact)
    if python_sizes != library_sizes:
        raise PlannerLibraryError(
            f"search, node and contact have {library_sizes} bytes in the C library, and {python_sizes} in Python"
        )
    expand = library.snakesim_planner_expand
    expand.restype = ctypes.c_int64
    expand.argtypes = [ctypes.POINTER(NativeSearch)]
    mark_obstacle = library.snakesim_planner_mark_obstacle
    mark_obstacle.restype = None
    mark_obstacle.argtypes = [
        ctypes.POINTER(NativeGrid),
        ctypes.POINTER(NativeWindow),
        ctypes.c_int64,
    ]
    return PlannerLibrary(expand, mark_obstacle, layout)


def is_native_available() -> bool:
    """Return whether the C library can be loaded here."""
    return load_library() is not None


def explain_missing_library() -> str:
    """Return why the C library cannot be loaded here; an empty text if it can."""
    return load_shared_library(PLANNER_LIBRARY).problem
