"""Contacts of a robot without contact sensors: estimated from joint torques, in the form that sensors publish."""

from typing import NamedTuple

import msgspec
import numpy as np

from snakesim_gnc.guidance.contacts.contact_estimate import EstimatedPush, estimate_pushes
from snakesim_hal.model.geometry.kinematics import compute_contact_tangents
from snakesim_hal.wire.messages import (
    Contact,
    Contacts,
    Imu,
    JointState,
    Pose,
    RobotDescription,
    WorldModel,
)

NO_IMU = Imu(tick=0, timestamp_ns=0, link=[], angular_velocity_rad_s=[], acceleration_m_s2=[])


class EstimatedContacts(NamedTuple):
    """The contacts at one joint state."""

    contacts: Contacts
    confidence: list[float]  # of each contact, 0 to 1


class ContactEstimator:
    """Estimates the contacts of one robot, all of whose joints measure torque.

    A joint without a torque measurement would hide all contacts ahead of it: see `can_estimate_contacts`.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot

    def estimate_contacts(
        self, joints: JointState, imu: Imu | None, pose: Pose | None
    ) -> EstimatedContacts | None:
        """Estimate the contacts of the body from its joint torques, or return None while a joint's values are outdated.

        Args:
            joints: Joint state with torques.
            imu: Newest IMU readings; used only if they have the same timestamp as the joints. None if there are none.
            pose: Pose sample, used for the velocity of the base; None if it is unknown.

        Returns:
            The contacts as a sensor would publish them, with a confidence for each.
        """
        if not all(joints.valid):
            return None
        imu_of_joints = NO_IMU
        if imu is not None and imu.timestamp_ns == joints.timestamp_ns:
            imu_of_joints = imu
        pushes = estimate_pushes(
            self._robot,
            joints.angle_rad,
            joints.velocity_rad_s,
            joints.torque_nm,
            imu_of_joints,
            pose,
        )
        contacts = [self._make_contact(push) for push in pushes]
        message = Contacts(tick=joints.tick, timestamp_ns=joints.timestamp_ns, contacts=contacts)
        return EstimatedContacts(message, [push.confidence for push in pushes])

    def _make_contact(self, push: EstimatedPush) -> Contact:
        """Convert a push into the message of a contact at the skin of the link, on the side of the obstacle."""
        normal_l = np.array(push.normal_l)
        position_l = (
            np.array([push.distance_from_rear_joint_m, 0.0, 0.0])
            - self._robot.links[push.link].radius_m * normal_l
        )
        tangent_1_l, tangent_2_l = compute_contact_tangents(push.normal_l)
        return Contact(
            link=push.link,
            obstacle=None,
            position_l=tuple(position_l.tolist()),
            normal_l=push.normal_l,
            tangent_1_l=tangent_1_l,
            tangent_2_l=tangent_2_l,
            force_l=tuple((push.force_n * normal_l).tolist()),
            torque_l=(0.0, 0.0, 0.0),
        )


def can_estimate_contacts(robot: RobotDescription) -> bool:
    """Return whether all joints of the robot measure their torque."""
    return all("torque" in joint.measures for joint in robot.joints)


def mark_estimated(world: WorldModel, estimated: EstimatedContacts) -> WorldModel:
    """Return a world made with estimated contacts, marked as such, with the confidence of each contact.

    A push where the known map has no obstacle is noise, and left out.
    """
    contacts = [
        msgspec.structs.replace(contact, confidence=confidence)
        for contact, confidence in zip(world.contacts, estimated.confidence, strict=True)
        if contact.obstacle is not None
    ]
    return msgspec.structs.replace(world, contacts=contacts, contacts_from="joint_torques")
