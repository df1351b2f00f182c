"""Reports the forces that `obstacle_aided` wants on obstacles, and why the body does not move."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.contact_forces import NetContactForce, explain_standstill
from snakesim_gnc.control.push import BodyContacts, NormalizedPush
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.wire.messages import WorldContact, WorldModel

MAX_REPORTED_PUSH_POINTS = 64  # push-points in a message


def make_push_point_messages(
    body: PlanarBody,
    world: WorldModel,
    contacts: BodyContacts,
    push: NormalizedPush,
    force_n: float,
) -> list[WorldContact]:
    """Return the contacts that push, as messages with their desired forces.

    Args:
        body: Lengths and indices of the robot's body.
        world: The world model in which the contacts were found.
        contacts: Contacts of the body.
        push: Contact forces and joint torques for 1 N along the body.
        force_n: Desired force along the body.

    Returns:
        Messages of the contacts with a force above zero, tail to head, at most MAX_REPORTED_PUSH_POINTS.
    """
    points: list[WorldContact] = []
    for k in np.argsort(contacts.body_s_m, kind="stable").tolist():
        if push.contact_forces[k] > 0.0:
            points.append(
                _describe_push_point(
                    body, world, contacts, k, force_n * float(push.contact_forces[k])
                )
            )
    return points[:MAX_REPORTED_PUSH_POINTS]


def _describe_push_point(
    body: PlanarBody,
    world: WorldModel,
    contacts: BodyContacts,
    contact_index: int,
    push_magnitude_n: float,
) -> WorldContact:
    """Return the message that reports one contact and the force with which the body pushes there.

    Args:
        body: Lengths and indices of the robot's body.
        world: The world model.
        contacts: All contacts of the body.
        contact_index: Index of the contact in `contacts`.
        push_magnitude_n: Magnitude of the push, as a multiple of the contact's direction d_c, which may be longer
            than 1.
    """
    x, y = contacts.positions_w[contact_index].tolist()
    direction_x, direction_y = contacts.directions_w[contact_index].tolist()
    length = float(np.hypot(direction_x, direction_y))
    # The force is parallel to the reported normal, which so includes friction.
    normal_x = direction_x / length
    normal_y = direction_y / length
    force_n = push_magnitude_n * length
    # Of the two tangents, report the one towards the head.
    sign = 1.0 if contacts.tangents_w[contact_index] @ (direction_y, -direction_x) > 0.0 else -1.0
    body_s_m = float(contacts.body_s_m[contact_index])
    return WorldContact(
        link=body.find_link_at(body_s_m),
        obstacle=world.obstacles[int(contacts.obstacle_index[contact_index])].name,
        body_s_m=body_s_m,
        position_w=(x, y, world.base_position_w[2]),
        normal_w=(normal_x, normal_y, 0.0),
        tangent_w=(sign * normal_y, -sign * normal_x, 0.0),
        force_w=(force_n * normal_x, force_n * normal_y, 0.0),
    )


def explain_push_standstill(
    contacts: BodyContacts,
    push: NormalizedPush,
    force_n: float,
    max_force_n: float,
    net_force: NetContactForce | None,
    push_points: Sequence[str],
) -> tuple[bool, str]:
    """Explain why a body that is pushed forward does not move.

    Args:
        contacts: Contacts of the body.
        push: Contact forces and joint torques for 1 N along the body.
        force_n: Desired force along the body.
        max_force_n: Maximum force along the body within the limits of joint torques and contact forces.
        net_force: Measured contact forces along the body; None without a contact sensor.
        push_points: Names of the obstacles that the body should push off.

    Returns:
        Whether the body is jammed, and the reason as text.
    """
    if not len(contacts):
        return False, "standing still: no obstacle is near enough to push off"
    if not push.is_balanced:
        obstacles = "the obstacle"
        if len(contacts) > 1:
            obstacles = f"the {len(contacts)} obstacles"
        return (
            False,
            f"standing still: contacts lost, {obstacles} beside the body cannot push it forward",
        )
    if force_n >= max_force_n:
        return (
            False,
            f"standing still: torques and contacts allow no more than {max_force_n:.1f} N along the body",
        )
    return explain_standstill(force_n, net_force, push_points)
