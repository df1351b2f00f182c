"""Report of the forces on obstacles: where, how much, and why the body stands. Pure."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.carried import NetContactForce, what_holds
from snakesim_gnc.control.push import Push, Touches
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.wire.messages import World, WorldContact

MAX_REPORTED = 64  # push-points in a message


def push_points(body: PlanarBody, world: World, touches: Touches, push: Push, force_n: float) -> list[WorldContact]:
    """The obstacles that are pushed, tail to head, with the wanted forces. world: that the touches were found in."""
    height, points = world.base_position_w[2], list[WorldContact]()
    for k in np.argsort(touches.body_s_m, kind="stable").tolist():
        if push.lambdas[k] <= 0.0:
            continue
        (x, y), (nx, ny) = touches.places_w[k].tolist(), touches.directions_w[k].tolist()
        ahead = 1.0 if touches.tangents_w[k] @ (ny, -nx) > 0.0 else -1.0
        size = float(np.hypot(nx, ny))
        nx, ny, force = nx / size, ny / size, force_n * float(push.lambdas[k]) * size
        points.append(
            WorldContact(
                link=body.link_at(float(touches.body_s_m[k])),
                obstacle=world.obstacles[int(touches.obstacle[k])].name,
                body_s_m=float(touches.body_s_m[k]),
                position_w=(x, y, height),
                normal_w=(nx, ny, 0.0),
                tangent_w=(ahead * ny, -ahead * nx, 0.0),
                force_w=(force * nx, force * ny, 0.0),
            )
        )
    return points[:MAX_REPORTED]


def why_it_stands(
    touches: Touches,
    push: Push,
    force_n: float,
    max_force_n: float,
    carried: NetContactForce | None,
    names: Sequence[str],
) -> tuple[bool, str]:
    """Whether it is jammed, and the class of the stall.

    force_n: wanted along the body; max_force_n: what torques and contacts allow. carried: what contacts really do along
    it; None when no sensor tells. names: of the obstacles that are to be pushed off.
    """
    if not len(touches):
        return False, "standing still: no obstacle is near enough to push off"
    if not push.balanced:
        beside = "the obstacle" if len(touches) == 1 else f"the {len(touches)} obstacles"
        return False, f"standing still: contacts lost, {beside} beside the body cannot push it forward"
    if force_n >= max_force_n:
        return False, f"standing still: torques and contacts allow no more than {max_force_n:.1f} N along the body"
    return what_holds(force_n, carried, names)
