"""Push-points: where the path passes an obstacle, and at which of these places the body is. Pure.

The geometry is the planned one: the path's point nearest to the obstacle, and the path's normal there. A measured
contact point moves along a link as joints move; the planned one does not. Measurements decide only whether the body is
near enough to push.
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

COARSE_M = 0.005
FINE_M = 0.0002


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
    """The place on the route nearest to an obstacle of any shape, within `window_m` of `near_s_m`."""
    if obstacle.shape == "box":
        s, push, distance = _past_box(route, obstacle, near_s_m, window_m)
    else:
        center = np.array(obstacle.position_w[:2])
        s = route.project(center, near_s_m, window_m)
        x, y = route.at(s)
        push = (x - float(center[0]), y - float(center[1]))
        distance = math.hypot(*push) - obstacle.radius_m
    heading = route.heading_rad(s)
    tangent = (math.cos(heading), math.sin(heading))
    side = 1 if tangent[0] * push[1] - tangent[1] * push[0] >= 0 else -1
    return PlannedContact(
        obstacle=obstacle.name,
        path_s_m=s,
        point_w=route.at(s),
        normal_w=(-side * tangent[1], side * tangent[0]),
        tangent_w=tangent,
        side=side,
        clearance_m=distance - body_radius_m,
    )


def _past_box(route: Route, box: Obstacle, near_s_m: float, window_m: float) -> tuple[float, Planar, float]:
    """Arc length nearest to a box, the direction from the box to there, and the distance."""
    outline, step, low, high = Outlines.of([box]), COARSE_M, near_s_m - window_m, near_s_m + window_m
    s, away, distance = near_s_m, np.zeros(2), 0.0
    for finer in (FINE_M, 0.0):
        places = np.arange(low, high, step)
        distances, normals = outline.towards(route.position_w(places), np.zeros(len(places), dtype=np.intp))
        best = int(np.argmin(distances))
        s, away, distance = float(places[best]), normals[best], float(distances[best])
        low, high, step = s - step, s + step, finer
    return s, (float(away[0]), float(away[1])), distance


def push_points(
    planned: Sequence[PlannedContact],
    kept: Collection[str],
    body_pose: BodyPose,
    measured_w: Floats,
    node_body_s_m: Sequence[float],
    *,
    gap_m: float,
    give_up_gap_m: float,
    end_m: float,
) -> list[PushPoint]:
    """The planned contacts that the body can push at now, tail to head.

    One counts when the body covers it, `end_m` from either tip or more, and the measured body is at most `gap_m` from
    it, or `give_up_gap_m` if it is among `kept`: in contact, or already used for pushing. measured_w: (2, n_nodes).
    node_body_s_m: (n_nodes,), arc lengths along the body.
    """
    places: list[float] = body_pose.node_s_m.tolist()
    xs, ys = measured_w.tolist()
    length = node_body_s_m[-1]
    found: list[PushPoint] = []
    for contact in planned:
        i = bisect_right(places, contact.path_s_m) - 1
        if not 0 <= i < len(places) - 1:
            continue
        share = (contact.path_s_m - places[i]) / (places[i + 1] - places[i])
        body_s = node_body_s_m[i] + share * (node_body_s_m[i + 1] - node_body_s_m[i])
        if not end_m < body_s < length - end_m:
            continue
        off_x = xs[i] + share * (xs[i + 1] - xs[i]) - contact.point_w[0]
        off_y = ys[i] + share * (ys[i + 1] - ys[i]) - contact.point_w[1]
        gap = contact.clearance_m + off_x * contact.normal_w[0] + off_y * contact.normal_w[1]
        if abs(gap) <= (give_up_gap_m if contact.obstacle in kept else gap_m):  # deep inside: it is on the other side
            found.append(PushPoint(contact, body_s, gap))
    found.sort(key=lambda p: p.body_s_m)
    return found
