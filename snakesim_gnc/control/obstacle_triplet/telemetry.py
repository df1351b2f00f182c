"""Telemetry of the obstacle-triplet controller: its triplet, forces and torques."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.obstacle_triplet.selection import Choice
from snakesim_gnc.control.obstacle_triplet.statics import compute_joint_torques
from snakesim_gnc.geometry.body_on_path import BodyPose
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import World, WorldContact


def compute_bending_nm(body: PlanarBody, body_pose: BodyPose, choice: Choice, force_n: float) -> Floats:
    """Return the torque of every joint for the planned contact forces, (n_joints,) in N·m.

    Args:
        body: the robot's body.
        body_pose: the body as it lies on the path.
        choice: the triplet that pushes.
        force_n: propulsion force; the tether's force, which balances it, stands for all resistance.
    """
    places_m = np.array(choice.body_s_m)
    unit_nm = compute_joint_torques(
        body.joints_w(body_pose), body.joint_s_m, places_m, choice.triplet.unit_wrenches
    )  # for 1 N of propulsion
    return force_n * unit_nm


def make_contact_messages(
    body: PlanarBody, world: World, choice: Choice, forces_n: Sequence[float]
) -> list[WorldContact]:
    """Return the three contacts of a triplet with their desired forces, as messages.

    Args:
        body: the robot's body.
        world: the world model, for the height of the body.
        choice: the triplet, and where its contacts are on the body.
        forces_n: desired force of each contact along its normal.

    Returns:
        The contacts, tail to head.
    """
    height_m = world.base_position_w[2]
    messages: list[WorldContact] = []
    for contact, body_s_m, force_n in zip(choice.triplet.contacts, choice.body_s_m, forces_n, strict=True):
        x, y = contact.point_w
        nx, ny = contact.normal_w
        tx, ty = contact.tangent_w
        messages.append(
            WorldContact(
                link=body.link_at(body_s_m),
                obstacle=contact.obstacle,
                body_s_m=body_s_m,
                position_w=(x, y, height_m),
                normal_w=(nx, ny, 0.0),
                tangent_w=(tx, ty, 0.0),
                force_w=(force_n * nx, force_n * ny, 0.0),
            )
        )
    return messages
