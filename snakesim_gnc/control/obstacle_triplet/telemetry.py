"""Telemetry of the obstacle-triplet controller: triplet, forces and torques. Pure."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.obstacle_triplet.selection import Choice
from snakesim_gnc.control.obstacle_triplet.statics import torque_under
from snakesim_gnc.geometry.body_on_path import BodyPose
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import World, WorldContact


def bending_nm(body: PlanarBody, body_pose: BodyPose, choice: Choice, force_n: float) -> Floats:
    """Torque of every joint for the solved forces, (n_joints,); the tether's force represents all resistance."""
    places = np.array(choice.body_s_m)
    return force_n * torque_under(body.joints_w(body_pose), body.joint_s_m, places, choice.triplet.unit_wrenches)


def planned_contacts(body: PlanarBody, world: World, choice: Choice, forces_n: Sequence[float]) -> list[WorldContact]:
    """The triplet's planned push-points, with the solved forces, tail to head."""
    height = world.base_position_w[2]
    points: list[WorldContact] = []
    for contact, body_s, force in zip(choice.triplet.contacts, choice.body_s_m, forces_n, strict=True):
        (x, y), (nx, ny), (tx, ty) = contact.point_w, contact.normal_w, contact.tangent_w
        points.append(
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
    return points
