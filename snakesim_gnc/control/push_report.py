"""Reports the forces that `obstacle_aided` wants on obstacles, and why the body does not move."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.contact_forces import NetContactForce, explain_standstill
from snakesim_gnc.control.push import Touches, UnitPush
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.wire.messages import World, WorldContact

MAX_REPORTED = 64  # push-points in a message


def push_points(body: PlanarBody, world: World, touches: Touches, push: UnitPush, force_n: float) -> list[WorldContact]:
    """Return the push-points with their desired forces, tail to head.

    Args:
        body: model of the body.
        world: the world model in which the contacts were found.
        touches: contacts of the body.
        push: forces for 1 N along the body.
        force_n: desired force along the body.
    """
    points: list[WorldContact] = []
    for k in np.argsort(touches.body_s_m, kind="stable").tolist():
        if push.lambdas[k] > 0.0:
            points.append(_describe_push_point(body, world, touches, k, force_n * float(push.lambdas[k])))
    return points[:MAX_REPORTED]


def _describe_push_point(body: PlanarBody, world: World, touches: Touches, k: int, push_n: float) -> WorldContact:
    """Return the message that reports one contact and the force with which the body pushes there.

    Args:
        body: lengths and indices of the robot's body.
        world: the world model.
        touches: all contacts.
        k: index of the contact in `touches`.
        push_n: size of its push, in multiples of its direction d_c.
    """
    x, y = touches.places_w[k].tolist()
    direction_x, direction_y = touches.directions_w[k].tolist()
    length = float(np.hypot(direction_x, direction_y))
    # The force is parallel to the reported normal, which so includes friction.
    normal_x = direction_x / length
    normal_y = direction_y / length
    force_n = push_n * length
    # Of the two tangents, report the one towards the head.
    sign = 1.0 if touches.tangents_w[k] @ (direction_y, -direction_x) > 0.0 else -1.0
    body_s_m = float(touches.body_s_m[k])
    return WorldContact(
        link=body.link_at(body_s_m),
        obstacle=world.obstacles[int(touches.obstacle[k])].name,
        body_s_m=body_s_m,
        position_w=(x, y, world.base_position_w[2]),
        normal_w=(normal_x, normal_y, 0.0),
        tangent_w=(sign * normal_y, -sign * normal_x, 0.0),
        force_w=(force_n * normal_x, force_n * normal_y, 0.0),
    )


def explain_push_standstill(
    touches: Touches,
    push: UnitPush,
    force_n: float,
    max_force_n: float,
    net_force: NetContactForce | None,
    push_points: Sequence[str],
) -> tuple[bool, str]:
    """Explain why a body that is pushed forward does not move.

    Args:
        touches: contacts of the body.
        push: contact forces and joint torques for 1 N along the body.
        force_n: desired force along the body.
        max_force_n: maximum of that force within the limits of torques and contact forces.
        net_force: measured contact forces along the body; None without a sensor.
        push_points: names of the obstacles that should be pushed.

    Returns:
        Whether the body is jammed, and the reason as text.
    """
    if not len(touches):
        return False, "standing still: no obstacle is near enough to push off"
    if not push.balanced:
        obstacles = "the obstacle"
        if len(touches) > 1:
            obstacles = f"the {len(touches)} obstacles"
        return False, f"standing still: contacts lost, {obstacles} beside the body cannot push it forward"
    if force_n >= max_force_n:
        return False, f"standing still: torques and contacts allow no more than {max_force_n:.1f} N along the body"
    return explain_standstill(force_n, net_force, push_points)
