"""The contacts of the bodies of search nodes, and the propulsion margin that they give. Pure.

A contact normal is a unit vector from the obstacle to the body: the direction in which the obstacle pushes the body.
In shapes, n is the number of nodes or points. Points are in the world frame.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import compute_wrenches
from snakesim_gnc.navigation.obstacle_grid import NO_OBSTACLE, ObstacleGrid
from snakesim_gnc.navigation.path_search.margin import compute_margins_n
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer
from snakesim_gnc.navigation.path_search.search_parameters import (
    MAX_FRONTAL,
    MIN_PUSH,
    SearchParameters,
)
from snakesim_gnc.navigation.path_search.search_task import SearchTask
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class ObstacleContacts:
    """The nearest obstacle at each of n points on the axes of bodies, and whether it is a contact there."""

    propulsion: Floats  # (n,) normal . goal, -1 to 1: positive propels, negative brakes; 0 without a contact
    is_usable: Bools  # (n,) a contact that counts for the margin; obstacle, gap and wrench are valid only there
    obstacle: Ints  # (n,) index
    gap_m: Floats  # (n,) between skin and obstacle
    wrench: Floats  # (n, 3) of a normal force of 1 N with its friction: fx, fy, moment about the task's origin


def find_obstacle_contacts(
    obstacles: ObstacleGrid,
    points_w: Floats,
    tangents: Floats,
    parameters: SearchParameters,
    task: SearchTask,
) -> ObstacleContacts:
    """Find the obstacles that bodies touch at points on their axes, and the force that these contacts give.

    A contact is a small gap at the side of the body. Obstacles ahead of the body, which a head would bump into, are not
    contacts. Friction acts against the motion along the tangent.

    Args:
        obstacles: The map.
        points_w: (n, 2) the points, m.
        tangents: (n, 2) unit vectors along the axes.
        parameters: Size of the robot's body, and the assumed friction of obstacles.
        task: Direction of the goal, and the origin of moments.

    Returns:
        For each point, the nearest obstacle, the gap, whether it is a usable contact, and the wrench of 1 N there.
    """
    nearest = obstacles.find_nearest(points_w[:, 0], points_w[:, 1])
    normals = nearest.normal_w
    gap_m = nearest.distance_m - parameters.radius_m
    has_obstacle = nearest.obstacle_index != NO_OBSTACLE
    is_close = gap_m < parameters.contact_distance_m
    is_at_side = np.abs(_dot(normals, tangents)) < MAX_FRONTAL
    is_contact = has_obstacle & is_close & is_at_side
    propulsion = _dot(normals, task.travel_direction_w)
    # On the skin, from the origin.
    contact_points_m = points_w - normals * parameters.radius_m - task.origin_w
    unit_force = normals - parameters.assumed_obstacle_friction * tangents
    return ObstacleContacts(
        propulsion=np.where(is_contact, propulsion, 0.0),
        is_usable=is_contact & (propulsion > MIN_PUSH),
        obstacle=nearest.obstacle_index,
        gap_m=gap_m,
        wrench=compute_wrenches(contact_points_m, unit_force),
    )


def compute_node_margins_n(nodes: NodeLayer, parameters: SearchParameters) -> Floats:
    """Return the propulsion margin in N of each node's body, (n,), from its contacts and its drag.

    Contacts near the tail end and near the head are left out, because the body cannot push there.
    """
    first_s_m = nodes.path_length_m - parameters.body_length_m + parameters.unused_tail_m
    last_s_m = nodes.path_length_m - parameters.unused_head_m
    is_usable = (nodes.contact_arc_length_m >= first_s_m) & (nodes.contact_arc_length_m <= last_s_m)
    usable_wrenches = np.where(is_usable[..., None], nodes.contact_wrench, 0.0)
    # Wrench of a drag of 1 N, spread over the whole body.
    drag_per_newton = nodes.drag_m / parameters.body_length_m
    return compute_margins_n(usable_wrenches, drag_per_newton)


def _dot(a: Floats, b: Floats) -> Floats:
    """Return a . b of vectors (n, 2), or (2,) that counts for all. BLAS would round differently on other processors."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
