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

from snakesim_gnc.geometry.body_on_path import PathBodyPose
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle

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
    # From the obstacle to a body that lies on the path; negative when it would overlap.
    clearance_m: float


@dataclass(frozen=True)
class _NearestPathPoint:
    """The point of a path that is nearest to a box."""

    path_s_m: float  # arc length on the path
    distance_m: float  # from the surface of the box
    direction_from_box_w: Planar  # unit vector


@dataclass(frozen=True)
class PushPoint:
    """A planned contact, and the place along the body that is at it now."""

    contact: PlannedContact
    body_s_m: float  # from the tail end
    gap_m: float  # from the obstacle to the measured body, across the path


def plan_contact(
    route: Route,
    obstacle: KnownObstacle,
    body_radius_m: float,
    *,
    search_middle_s_m: float,
    window_m: float,
) -> PlannedContact:
    """Find the point of the route that is nearest to an obstacle, where the body will push off the obstacle.

    Args:
        route: The path.
        obstacle: An obstacle of any shape.
        body_radius_m: Radius of the robot's body.
        search_middle_s_m: Arc length on the route that is the middle of the searched part.
        window_m: Length of the searched part on either side of `search_middle_s_m`.

    Returns:
        The contact, with the normal from the obstacle into the body and the tangent towards the head.
    """
    if obstacle.shape == "box":
        nearest_point = _find_nearest_point_to_box(route, obstacle, search_middle_s_m, window_m)
        nearest_s_m = nearest_point.path_s_m
        direction_from_obstacle_w = nearest_point.direction_from_box_w
        distance_m = nearest_point.distance_m
    else:
        center_w = np.array(obstacle.position_w[:2])
        nearest_s_m = route.project_point(center_w, search_middle_s_m, window_m)
        x, y = route.compute_point(nearest_s_m)
        direction_from_obstacle_w = (x - float(center_w[0]), y - float(center_w[1]))
        distance_m = math.hypot(*direction_from_obstacle_w) - obstacle.radius_m
    heading_rad = route.compute_heading_rad(nearest_s_m)
    tangent = (math.cos(heading_rad), math.sin(heading_rad))
    # The cross product of tangent and direction is positive if the path passes on the left of the obstacle.
    is_pushed_left = (
        tangent[0] * direction_from_obstacle_w[1] - tangent[1] * direction_from_obstacle_w[0] >= 0
    )
    side = 1 if is_pushed_left else -1
    return PlannedContact(
        obstacle=obstacle.name,
        path_s_m=nearest_s_m,
        point_w=route.compute_point(nearest_s_m),
        normal_w=(-side * tangent[1], side * tangent[0]),
        tangent_w=tangent,
        side=side,
        clearance_m=distance_m - body_radius_m,
    )


def _find_nearest_point_to_box(
    route: Route, box: KnownObstacle, search_middle_s_m: float, window_m: float
) -> _NearestPathPoint:
    """Find the point of a route that is nearest to a box: first in coarse steps, then in fine steps around the best.

    Args:
        route: The path.
        box: The obstacle.
        search_middle_s_m: Arc length on the route that is the middle of the searched part.
        window_m: Length of the searched part on either side of `search_middle_s_m`.
    """
    box_outline = ObstacleOutlines.from_obstacles([box])
    coarse_candidates_s_m = np.arange(
        search_middle_s_m - window_m, search_middle_s_m + window_m, COARSE_STEP_M
    )
    coarse_s_m = _select_nearest_to_box(route, box_outline, coarse_candidates_s_m).path_s_m
    fine_candidates_s_m = np.arange(
        coarse_s_m - COARSE_STEP_M, coarse_s_m + COARSE_STEP_M, FINE_STEP_M
    )
    return _select_nearest_to_box(route, box_outline, fine_candidates_s_m)


def _select_nearest_to_box(
    route: Route, box_outline: ObstacleOutlines, candidates_s_m: Floats
) -> _NearestPathPoint:
    """Return the candidate that is nearest to a box.

    Args:
        route: The path.
        box_outline: Outlines of which the box is the first and only one.
        candidates_s_m: (n,) arc lengths of the candidates on the route.
    """
    outline_indices = np.zeros(len(candidates_s_m), dtype=np.intp)
    distances_m, normals_w = box_outline.compute_distances_and_normals(
        route.compute_positions_w(candidates_s_m), outline_indices
    )
    nearest = int(np.argmin(distances_m))
    normal_x, normal_y = normals_w[nearest]
    return _NearestPathPoint(
        path_s_m=float(candidates_s_m[nearest]),
        distance_m=float(distances_m[nearest]),
        direction_from_box_w=(float(normal_x), float(normal_y)),
    )


def find_push_points(
    planned_contacts: Sequence[PlannedContact],
    retained_obstacles: Collection[str],
    body_pose: PathBodyPose,
    measured_points_w: Floats,
    body_points_s_m: Sequence[float],
    *,
    gap_m: float,
    give_up_gap_m: float,
    end_m: float,
) -> list[PushPoint]:
    """Find the planned contacts that the body can push at now.

    A planned contact is a push-point if the body covers it, and the measured body is near enough to its obstacle.

    Args:
        planned_contacts: Contacts that were planned where the path passes obstacles.
        retained_obstacles: Names of the obstacles in contact, and of those that the body already pushes at.
        body_pose: The body as it lies on the path.
        measured_points_w: (2, n_points) tail end, joints that bend and head end of the measured body, m.
        body_points_s_m: (n_points,) arc lengths of these points from the tail end along the body.
        gap_m: Maximum distance of the measured body from an obstacle.
        give_up_gap_m: Maximum distance from an obstacle in `retained_obstacles`, instead of `gap_m`.
        end_m: Minimum distance of a push-point along the body from either tip.

    Returns:
        The push-points, tail to head.
    """
    # Plain lists: this runs in every tick, and for single numbers they are faster than arrays.
    points_path_s_m: list[float] = body_pose.body_points_s_m.tolist()
    x_m, y_m = measured_points_w.tolist()
    length_m = body_points_s_m[-1]
    points: list[PushPoint] = []
    for contact in planned_contacts:
        # The contact is on the segment from node i to node i + 1, at this fraction of it.
        segment = bisect_right(points_path_s_m, contact.path_s_m) - 1
        if not 0 <= segment < len(points_path_s_m) - 1:
            continue
        fraction = (contact.path_s_m - points_path_s_m[segment]) / (
            points_path_s_m[segment + 1] - points_path_s_m[segment]
        )
        body_s_m = body_points_s_m[segment] + fraction * (
            body_points_s_m[segment + 1] - body_points_s_m[segment]
        )
        if not end_m < body_s_m < length_m - end_m:
            continue
        # Offset of the measured body from the planned contact, and its gap to the obstacle along the normal.
        offset_x_m = (
            x_m[segment] + fraction * (x_m[segment + 1] - x_m[segment]) - contact.point_w[0]
        )
        offset_y_m = (
            y_m[segment] + fraction * (y_m[segment + 1] - y_m[segment]) - contact.point_w[1]
        )
        measured_gap_m = (
            contact.clearance_m
            + offset_x_m * contact.normal_w[0]
            + offset_y_m * contact.normal_w[1]
        )
        max_gap_m = give_up_gap_m if contact.obstacle in retained_obstacles else gap_m
        # A large negative gap does not count either: the body is on the other side of the obstacle.
        if abs(measured_gap_m) <= max_gap_m:
            points.append(PushPoint(contact, body_s_m, measured_gap_m))
    points.sort(key=lambda point: point.body_s_m)
    return points
