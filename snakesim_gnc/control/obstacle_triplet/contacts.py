"""Push-points: where the path passes an obstacle, and which of these places the body covers.

The geometry is the planned one: the point of the path that is nearest to the obstacle, and the normal of the path
there. A measured contact point moves along a link while joints move; the planned one does not. Measurements decide only
whether the body is near enough to push.
"""

import math
from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_gnc.geometry.body_on_path import BodyPose
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Obstacle

Planar = tuple[float, float]

# Spacing of the places that are tried in the search for the place nearest to a box: first all, then around the best.
COARSE_STEP_M = 0.005
FINE_STEP_M = 0.0002


@dataclass(frozen=True)
class PlannedContact:
    """Where the path passes an obstacle."""

    obstacle: str
    path_s_m: float
    point_w: Planar
    normal_w: Planar  # from the obstacle into the body, across the path
    tangent_w: Planar  # along the path
    side: int  # +1: the obstacle is on the right of the path, and pushes to the left
    clearance_m: float  # from the obstacle to a body that lies on the path; negative when it would overlap


@dataclass(frozen=True)
class PushPoint:
    """A planned contact, and the place along the body that is at it now."""

    contact: PlannedContact
    body_s_m: float  # from the tail end
    gap_m: float  # from the obstacle to the measured body, across the path


def plan_contact(
    route: Route, obstacle: Obstacle, body_radius_m: float, *, near_s_m: float, window_m: float
) -> PlannedContact:
    """Find the place on the route that is nearest to an obstacle, where the body will push off it.

    Args:
        route: the path.
        obstacle: an obstacle of any shape.
        body_radius_m: radius of the robot's body.
        near_s_m: arc length on the route around which the search begins.
        window_m: distance from there within which it searches.

    Returns:
        The contact, with the normal from the obstacle into the body and the tangent towards the head.
    """
    if obstacle.shape == "box":
        s, away_w, distance_m = _find_place_at_box(route, obstacle, near_s_m, window_m)
    else:
        center_w = np.array(obstacle.position_w[:2])
        s = route.project(center_w, near_s_m, window_m)
        x, y = route.point_at(s)
        away_w = (x - float(center_w[0]), y - float(center_w[1]))
        distance_m = math.hypot(*away_w) - obstacle.radius_m
    heading_rad = route.heading_rad(s)
    tangent = (math.cos(heading_rad), math.sin(heading_rad))
    is_pushed_left = tangent[0] * away_w[1] - tangent[1] * away_w[0] >= 0
    side = 1 if is_pushed_left else -1
    return PlannedContact(
        obstacle=obstacle.name,
        path_s_m=s,
        point_w=route.point_at(s),
        normal_w=(-side * tangent[1], side * tangent[0]),
        tangent_w=tangent,
        side=side,
        clearance_m=distance_m - body_radius_m,
    )


def _find_place_at_box(route: Route, box: Obstacle, near_s_m: float, window_m: float) -> tuple[float, Planar, float]:
    """Find the place on a route that is nearest to a box, by a coarse and a fine search.

    Args:
        route: the path.
        box: the obstacle.
        near_s_m: arc length around which the search begins.
        window_m: how far from there it searches.

    Returns:
        The arc length of the place in m, the unit vector from the box to it, and its distance from the box in m.
    """
    outline = Outlines.from_obstacles([box])
    low = near_s_m - window_m
    high = near_s_m + window_m
    s = near_s_m
    away_w = np.zeros(2)
    distance_m = 0.0
    for step in (COARSE_STEP_M, FINE_STEP_M):
        places_m = np.arange(low, high, step)
        box_indices = np.zeros(len(places_m), dtype=np.intp)
        distances_m, normals_w = outline.distance_and_normal(route.position_w(places_m), box_indices)
        best = int(np.argmin(distances_m))
        s = float(places_m[best])
        away_w = normals_w[best]
        distance_m = float(distances_m[best])
        low = s - step
        high = s + step
    return s, (float(away_w[0]), float(away_w[1])), distance_m


def find_push_points(
    planned: Sequence[PlannedContact],
    retained: Collection[str],
    body_pose: BodyPose,
    measured_w: Floats,
    node_body_s_m: Sequence[float],
    *,
    gap_m: float,
    give_up_gap_m: float,
    end_m: float,
) -> list[PushPoint]:
    """Find the planned contacts that the body can push at now.

    One counts if the body covers it, and the measured body is near enough to it.

    Args:
        planned: planned contacts.
        retained: names of the obstacles in contact, and of those that the body already pushes at.
        body_pose: the body as it lies on the path.
        measured_w: (2, n_nodes) m, the measured body.
        node_body_s_m: (n_nodes,) arc lengths of the nodes from the tail end along the body.
        gap_m: maximum distance of the measured body from an obstacle.
        give_up_gap_m: the same for the obstacles in `retained`.
        end_m: minimum distance along the body from either tip.

    Returns:
        The push-points, tail to head.
    """
    # Plain lists: this runs in every tick, and for single numbers they are faster than arrays.
    node_s_m: list[float] = body_pose.node_s_m.tolist()
    x_m, y_m = measured_w.tolist()
    length_m = node_body_s_m[-1]
    points: list[PushPoint] = []
    for contact in planned:
        # The contact is on the segment from node i to node i + 1, at this fraction of it.
        i = bisect_right(node_s_m, contact.path_s_m) - 1
        if not 0 <= i < len(node_s_m) - 1:
            continue
        fraction = (contact.path_s_m - node_s_m[i]) / (node_s_m[i + 1] - node_s_m[i])
        body_s_m = node_body_s_m[i] + fraction * (node_body_s_m[i + 1] - node_body_s_m[i])
        if not end_m < body_s_m < length_m - end_m:
            continue
        # Offset of the measured body from the planned contact, and its gap to the obstacle along the normal.
        offset_x_m = x_m[i] + fraction * (x_m[i + 1] - x_m[i]) - contact.point_w[0]
        offset_y_m = y_m[i] + fraction * (y_m[i + 1] - y_m[i]) - contact.point_w[1]
        measured_gap_m = contact.clearance_m + offset_x_m * contact.normal_w[0] + offset_y_m * contact.normal_w[1]
        max_gap_m = give_up_gap_m if contact.obstacle in retained else gap_m
        # A large negative gap does not count either: the body is on the other side of the obstacle.
        if abs(measured_gap_m) <= max_gap_m:
            points.append(PushPoint(contact, body_s_m, measured_gap_m))
    points.sort(key=lambda point: point.body_s_m)
    return points
