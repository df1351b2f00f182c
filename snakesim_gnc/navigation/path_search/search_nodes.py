"""The nodes of the path search: one layer of them as arrays, with the contacts that the body would have. Pure.

A node is a place and heading of the head at the end of a path. It stores the newest contacts of the whole body as
wrenches, and the integral of the drag's wrench along the body: that is what its propulsion margin needs.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.obstacle_grid import NO_OBSTACLE
from snakesim_gnc.navigation.path_search.search_parameters import MAX_CONTACTS
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]

NO_PARENT = -1  # row of the parent of a start node


@dataclass
class NodeLayer:
    """Nodes at one depth of the search. Arrays have one row for each of n nodes; C is MAX_CONTACTS."""

    # The arc that led to the node.
    x_m: Floats  # (n,) end of the arc, world
    y_m: Floats  # (n,)
    heading_rad: Floats  # (n,) at the end of the arc, world
    curvature_per_m: Floats  # (n,)
    parent_row: Ints  # (n,) row in the layer before
    cost_m: Floats  # (n,) of the path from its start, in meters of path
    # Contacts of the body; the newest is last.
    contact_obstacle_index: Ints  # (n, C) index; NO_OBSTACLE in an empty slot
    contact_arc_length_m: Floats  # (n, C) arc length of the contact along the path
    contact_gap_m: Floats  # (n, C) between skin and obstacle
    # (n, C, 3) of a unit push: fx, fy, moment about the search's origin in m.
    contact_wrench: Floats
    # What resists the body.
    drag_m: Floats  # (n, 3) integral of the tangent's wrench over the whole body: m, m, m²
    arc_drag_m: Floats  # (n, 3) the part of that integral over the arc that led here
    propulsion_margin_n: Floats  # (n,) propulsion margin F*
    # The same for all nodes of a layer.
    path_length_m: float  # arc length from the start of the path

    def select_rows(self, rows: Ints) -> "NodeLayer":
        """Return a layer with copies of some of the nodes."""
        arrays = {
            field.name: getattr(self, field.name)[rows]
            for field in fields(self)
            if field.name != "path_length_m"
        }
        return NodeLayer(**arrays, path_length_m=self.path_length_m)

    def add_contacts(
        self,
        touches: Bools,
        obstacle_index: Ints,
        gap_m: Floats,
        wrench: Floats,
        arc_length_m: float,
    ) -> None:
        """Store a contact in each node of the search tree whose path touches an obstacle at an arc length.

        A path is a sequence of arcs. Consecutive arcs that touch the same obstacle are one contact: its gap and wrench
        are those of the closest point, and its arc length is updated at every arc. A contact with another obstacle
        becomes the newest of the MAX_CONTACTS contacts, in the last column, and the oldest, in column 0, is dropped.

        Args:
            touches: (n,) which nodes touch an obstacle at this arc length; the rows of all other nodes are ignored.
            obstacle_index: (n,) index of the touched obstacle.
            gap_m: (n,) gap between skin and obstacle, in m.
            wrench: (n, 3) wrench of a unit normal force: fx, fy, and moment in m.
            arc_length_m: Arc length of the contact along the path.
        """
        touches_same = touches & (self.contact_obstacle_index[:, -1] == obstacle_index)
        touches_nearer = touches_same & (gap_m < self.contact_gap_m[:, -1])
        touches_other = touches & ~touches_same
        for column_array in (
            self.contact_obstacle_index,
            self.contact_gap_m,
            self.contact_wrench,
            self.contact_arc_length_m,
        ):
            column_array[touches_other, :-1] = column_array[touches_other, 1:]
        is_updated = touches_other | touches_nearer
        self.contact_obstacle_index[is_updated, -1] = obstacle_index[is_updated]
        self.contact_gap_m[is_updated, -1] = gap_m[is_updated]
        self.contact_wrench[is_updated, -1] = wrench[is_updated]
        # Every touching node gets the new arc length, also if the gap is not smaller.
        self.contact_arc_length_m[touches, -1] = arc_length_m


def make_start_nodes(points_w: Floats, headings_rad: Floats) -> NodeLayer:
    """Return nodes without contacts and drag, from which a search starts.

    The layer gets copies, so that later changes of its arrays do not change the arguments.

    Args:
        points_w: (n, 2) positions in the world, m.
        headings_rad: (n,) directions in which the paths begin.
    """
    count = len(points_w)
    return NodeLayer(
        x_m=points_w[:, 0].copy(),
        y_m=points_w[:, 1].copy(),
        heading_rad=headings_rad.copy(),
        curvature_per_m=np.zeros(count),
        parent_row=np.full(count, NO_PARENT),
        cost_m=np.zeros(count),
        contact_obstacle_index=np.full((count, MAX_CONTACTS), NO_OBSTACLE),
        contact_arc_length_m=np.full((count, MAX_CONTACTS), -np.inf),
        contact_gap_m=np.full((count, MAX_CONTACTS), np.inf),
        contact_wrench=np.zeros((count, MAX_CONTACTS, 3)),
        drag_m=np.zeros((count, 3)),
        arc_drag_m=np.zeros((count, 3)),
        propulsion_margin_n=np.zeros(count),
        path_length_m=0.0,
    )


def compute_cell_numbers(
    x_m: Floats, y_m: Floats, heading_rad: Floats, cell_size_m: float, cell_size_rad: float
) -> NDArray[np.int64]:
    """Compute for each node the number of its cell of position and heading; nodes in the same cell share the number.

    Args:
        x_m: (n,) positions of the nodes in the world.
        y_m: (n,) positions of the nodes in the world.
        heading_rad: (n,) headings of the nodes.
        cell_size_m: Size of a cell in x and y.
        cell_size_rad: Size of a cell in heading.

    Returns:
        (n,) cell numbers. Distant cells may have the same number.
    """
    column = np.floor(x_m / cell_size_m).astype(np.int64)
    row = np.floor(y_m / cell_size_m).astype(np.int64)
    sector = np.floor(heading_rad / cell_size_rad).astype(np.int64)
    # Two primes keep the numbers of cells that are near each other apart.
    return (column * 100_003 + row) * 1009 + sector


def count_earlier_in_cell(cells: NDArray[np.int64]) -> Ints:
    """Return for each node, (n,), how many nodes before it have the same cell number."""
    # Nodes of one cell are next to each other in this order, and a stable sort keeps their order.
    order = np.argsort(cells, kind="stable")
    is_first_of_cell = np.concatenate(([True], np.diff(cells[order]) != 0))
    # For each sorted node, the sorted position at which its cell begins.
    cell_starts = np.flatnonzero(is_first_of_cell)
    own_cell_start = cell_starts[np.cumsum(is_first_of_cell) - 1]
    earlier_counts = np.empty(len(order), dtype=np.intp)
    earlier_counts[order] = np.arange(len(order)) - own_cell_start
    return earlier_counts
