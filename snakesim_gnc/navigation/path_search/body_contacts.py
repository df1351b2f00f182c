"""What the bodies of search nodes touch, and how hard they can push with it. Pure.

In shapes, n is the number of nodes or points. Points are in the world frame.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import wrenches
from snakesim_gnc.navigation.obstacle_grid import NO_OBSTACLE, ObstacleGrid
from snakesim_gnc.navigation.path_search.margin import compute_margins_n
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer
from snakesim_gnc.navigation.path_search.search_parameters import MAX_FRONTAL, MIN_PUSH, SearchParameters
from snakesim_gnc.navigation.path_search.search_task import SearchTask
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class TouchedObstacles:
    """What bodies touch at one arc length each. All arrays have one row for each of n points on their axes."""

    push: Floats  # (n,) towards the goal, n.g; 0 without a contact
    counts: Bools  # (n,) whether there is a contact that counts for the margin; the other arrays are valid only there
    obstacle: Ints  # (n,) index
    gap_m: Floats  # (n,) between skin and obstacle
    wrench: Floats  # (n, 3) of a unit push


def find_touched(
    obstacles: ObstacleGrid, points_w: Floats, tangents: Floats, parameters: SearchParameters, task: SearchTask
) -> TouchedObstacles:
    """Find the obstacles that bodies touch at points on their axes, and the push that these contacts allow.

    Args:
        obstacles: the map.
        points_w: (n, 2) the points, m.
        tangents: (n, 2) unit vectors along the axes.
        parameters: the robot, and the assumed friction of obstacles.
        task: direction of the goal, and the origin of moments.

    Returns:
        For each point, the nearest obstacle, the gap, whether it counts as a contact, and the wrench of a unit push.
    """
    nearest = obstacles.find_nearest(points_w[:, 0], points_w[:, 1])
    normals = nearest.normal_w
    gap_m = nearest.distance_m - parameters.radius_m
    frontal = np.abs(_dot(normals, tangents))
    is_contact = (nearest.obstacle != NO_OBSTACLE) & (gap_m < parameters.contact_distance_m) & (frontal < MAX_FRONTAL)
    push = _dot(normals, task.goal_w)
    skin_from_origin = points_w - normals * parameters.radius_m - task.origin_w
    unit_push = normals - parameters.assumed_obstacle_friction * tangents
    return TouchedObstacles(
        push=np.where(is_contact, push, 0.0),
        counts=is_contact & (push > MIN_PUSH),
        obstacle=nearest.obstacle,
        gap_m=gap_m,
        wrench=wrenches(skin_from_origin, unit_push),
    )


def compute_node_margins_n(nodes: NodeLayer, parameters: SearchParameters) -> Floats:
    """Return the propulsion margin of each node's body, (n,), with the contacts that are not near its ends."""
    first_s_m = nodes.s_m - parameters.body_length_m + parameters.unused_tail_m
    last_s_m = nodes.s_m - parameters.unused_head_m
    counts = (nodes.contact_s_m >= first_s_m) & (nodes.contact_s_m <= last_s_m)
    contacts = np.where(counts[..., None], nodes.contact_wrench, 0.0)
    return compute_margins_n(contacts, nodes.drag_m / parameters.body_length_m)


def _dot(a: Floats, b: Floats) -> Floats:
    """Return a . b of vectors (n, 2), or (2,) that counts for all. BLAS would round differently on other processors."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
