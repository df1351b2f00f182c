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


@dataclass
class NodeLayer:
    """Nodes at one depth of the search. Arrays have one row for each of n nodes; C is MAX_CONTACTS."""

    # The arc that led to the node.
    x_m: Floats  # (n,) end of the arc, world
    y_m: Floats  # (n,)
    heading_rad: Floats  # (n,) at the end of the arc, world
    curvature_per_m: Floats  # (n,)
    parent: Ints  # (n,) row in the layer before
    cost_m: Floats  # (n,) of the path from its start, in meters of path
    # Contacts of the body; the newest is last.
    obstacle: Ints  # (n, C) index; NO_OBSTACLE in an empty slot
    contact_s_m: Floats  # (n, C) arc length of the contact along the path
    contact_gap_m: Floats  # (n, C) between skin and obstacle
    contact_wrench: Floats  # (n, C, 3) of a unit push: fx, fy, moment about the search's origin in m
    # What resists the body.
    drag_m: Floats  # (n, 3) integral of the tangent's wrench over the whole body: m, m, m²
    arc_drag_m: Floats  # (n, 3) the part of that integral over the arc that led here
    propulsion_margin_n: Floats  # (n,) propulsion margin F*
    # The same for all nodes of a layer.
    path_length_m: float  # arc length from the start of the path

    def select_rows(self, rows: Ints) -> "NodeLayer":
        """Return a layer with copies of some of the nodes."""
        arrays = {
            field.name: getattr(self, field.name)[rows] for field in fields(self) if field.name != "path_length_m"
        }
        return NodeLayer(**arrays, path_length_m=self.path_length_m)

    def add_contacts(self, is_touching: Bools, obstacle: Ints, gap_m: Floats, wrench: Floats, s_m: float) -> None:
        """Store the contact of each node that touches an obstacle at an arc length.

        A body slides along an obstacle over several arcs. That is one contact, stored where the gap is smallest; its
        arc length is that of the newest arc. A contact with another obstacle takes a new slot and drops the oldest.

        Args:
            is_touching: (n,) which nodes touch an obstacle there; the other rows are ignored.
            obstacle: (n,) index of the obstacle.
            gap_m: (n,) gap between skin and obstacle.
            wrench: (n, 3) wrench of a unit push.
            s_m: Arc length of the contact.
        """
        is_same = is_touching & (self.obstacle[:, -1] == obstacle)
        is_nearer = is_same & (gap_m < self.contact_gap_m[:, -1])
        is_new = is_touching & ~is_same
        for slots in (self.obstacle, self.contact_gap_m, self.contact_wrench, self.contact_s_m):
            slots[is_new, :-1] = slots[is_new, 1:]
        is_stored = is_new | is_nearer
        self.obstacle[is_stored, -1] = obstacle[is_stored]
        self.contact_gap_m[is_stored, -1] = gap_m[is_stored]
        self.contact_wrench[is_stored, -1] = wrench[is_stored]
        self.contact_s_m[is_touching, -1] = s_m


def make_start_nodes(points_w: Floats, headings_rad: Floats) -> NodeLayer:
    """Return nodes without contacts and drag, from which a search starts.

    Args:
        points_w: (n, 2) positions in the world, m.
        headings_rad: (n,) directions in which the paths begin.
    """
    count = len(points_w)
    return NodeLayer(
        x_m=points_w[:, 0].copy(),
        y_m=points_w[:, 1].copy(),
        heading_rad=headings_rad,
        curvature_per_m=np.zeros(count),
        parent=np.full(count, NO_OBSTACLE),
        cost_m=np.zeros(count),
        obstacle=np.full((count, MAX_CONTACTS), NO_OBSTACLE),
        contact_s_m=np.full((count, MAX_CONTACTS), -np.inf),
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
    return (column * 100_003 + row) * 1009 + sector


def count_earlier_in_cell(cells: NDArray[np.int64]) -> Ints:
    """Return for each node, (n,), how many nodes before it have the same cell number."""
    order = np.argsort(cells, kind="stable")
    is_first = np.concatenate(([True], np.diff(cells[order]) != 0))
    cell_starts = np.flatnonzero(is_first)
    earlier_counts = np.empty(len(order), dtype=np.intp)
    earlier_counts[order] = np.arange(len(order)) - cell_starts[np.cumsum(is_first) - 1]
    return earlier_counts
