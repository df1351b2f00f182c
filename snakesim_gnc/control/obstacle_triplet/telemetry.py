"""Telemetry of the obstacle-triplet controller: its triplet, forces and torques."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.obstacle_triplet.selection import PropulsionChoice
from snakesim_gnc.control.obstacle_triplet.statics import compute_joint_torques
from snakesim_gnc.geometry.body_on_path import PathBodyPose
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import WorldContact, WorldModel


def compute_bending_torques_nm(
    body: PlanarBody, body_pose: PathBodyPose, choice: PropulsionChoice, force_n: float
) -> Floats:
    """Compute the torque of every joint for the planned contact forces.

    Args:
        body: Lengths and indices of the robot's body.
        body_pose: The body as it lies on the path.
        choice: The triplet that pushes.
        force_n: Propulsion force. The tether's force, which balances it, stands for all resistance.

    Returns:
        (n_joints,) torques in N·m, left turn positive.
    """
    contacts_s_m = np.array(choice.body_s_m)
    unit_torques_nm = compute_joint_torques(
        body.compute_joint_positions_w(body_pose),
        body.joint_s_m,
        contacts_s_m,
        choice.triplet.unit_wrenches,
    )  # for 1 N of propulsion
    return force_n * unit_torques_nm


def make_contact_messages(
    body: PlanarBody, world: WorldModel, choice: PropulsionChoice, forces_n: Sequence[float]
) -> list[WorldContact]:
    """Return the three contacts of a triplet with their desired forces, as messages.

    Args:
        body: The robot's body.
        world: The world model, for the height of the body.
        choice: The triplet, and where its contacts are on the body.
        forces_n: Desired force of each contact along its normal.

    Returns:
        The contacts, tail to head.
    """
    height_m = world.base_position_w[2]
    messages: list[WorldContact] = []
    for contact, body_s_m, force_n in zip(
        choice.triplet.contacts, choice.body_s_m, forces_n, strict=True
    ):
        x, y = contact.point_w
        normal_x, normal_y = contact.normal_w
        tangent_x, tangent_y = contact.tangent_w
        messages.append(
            WorldContact(
                link=body.find_link_at(body_s_m),
                obstacle=contact.obstacle,
                body_s_m=body_s_m,
                position_w=(x, y, height_m),
                normal_w=(normal_x, normal_y, 0.0),
                tangent_w=(tangent_x, tangent_y, 0.0),
                force_w=(force_n * normal_x, force_n * normal_y, 0.0),
            )
        )
    return messages
