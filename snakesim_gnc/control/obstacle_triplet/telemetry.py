"""What the obstacle-triplet controller tells of its triplet, forces and torques. Pure."""

import math
from collections.abc import Sequence

from snakesim_gnc.control.body_on_path import Lie
from snakesim_gnc.control.obstacle_triplet.selection import Choice
from snakesim_gnc.control.obstacle_triplet.statics import bending_torque_nm, loads
from snakesim_gnc.control.planar_body import PlanarBody
from snakesim_hal.messages import World, WorldContact


def bending(body: PlanarBody, lie: Lie, choice: Choice, forces_n: Sequence[float], force_n: float) -> list[float]:
    """Torque that the solved forces ask of every joint, tail to head; the tether's force stands for all resistance."""
    triplet = choice.triplet
    tangent = triplet.contacts[0].tangent_w
    pushed = loads(triplet.points_w, forces_n, triplet.normals_w, (-force_n * tangent[0], -force_n * tangent[1]))
    joints_w = body.joints_w(lie)
    torques: list[float] = bending_torque_nm(
        joints_w, body.joint_s_m, triplet.points_w, choice.body_s_m, pushed
    ).tolist()
    return torques


def planned_contacts(body: PlanarBody, world: World, choice: Choice, forces_n: Sequence[float]) -> list[WorldContact]:
    """The triplet's push-points where they are planned, with the forces that were solved for, tail to head."""
    height = world.base_position_w[2]
    told: list[WorldContact] = []
    for contact, body_s, force in zip(choice.triplet.contacts, choice.body_s_m, forces_n, strict=True):
        (x, y), (nx, ny), (tx, ty) = contact.point_w, contact.normal_w, contact.tangent_w
        told.append(
            WorldContact(
                link=body.link_at(body_s),
                obstacle=contact.obstacle,
                body_s_m=body_s,
                position_w=(x, y, height),
                normal_w=(nx, ny, 0.0),
                tangent_w=(tx, ty, 0.0),
                force_w=(force * nx, force * ny, 0.0),
            )
        )
    return told


def largest_contact_force_n(world: World) -> float:
    """Size of the strongest touch felt."""
    return max((math.hypot(*contact.force_w) for contact in world.contacts), default=0.0)
