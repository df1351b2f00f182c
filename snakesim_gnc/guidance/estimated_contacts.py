"""Contacts of a robot without contact sensors: the estimate from joint torques, told as such a sensor would."""

from typing import NamedTuple

import msgspec
import numpy as np

from snakesim_gnc.guidance.contact_estimate import FeltContact, estimate
from snakesim_hal.model.kinematics import tangents
from snakesim_hal.wire.messages import Contact, Contacts, Description, Imu, JointState, Pose, World

NO_IMU = Imu(tick=0, timestamp_ns=0, link=[], angular_velocity_rad_s=[], acceleration_m_s2=[])


class EstimatedContacts(NamedTuple):
    """Of one joint state."""

    contacts: Contacts
    confidence: list[float]  # of each contact, 0 to 1


class ContactEstimator:
    """Of one robot."""

    def __init__(self, robot: Description) -> None:
        self._robot = robot

    @classmethod
    def of(cls, robot: Description) -> "ContactEstimator | None":
        """None for a robot with a joint that does not measure its torque: that hides all that is ahead of it."""
        return cls(robot) if all("torque" in joint.measures for joint in robot.joints) else None

    def contacts(self, joints: JointState, imu: Imu | None, pose: Pose | None) -> EstimatedContacts | None:
        """None while a joint's numbers are outdated. imu: counts if it is of the same instant as the joints."""
        if not all(joints.valid):
            return None
        fresh = imu if imu is not None and imu.timestamp_ns == joints.timestamp_ns else NO_IMU
        felt = estimate(self._robot, joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, fresh, pose)
        contacts = [self._contact(one) for one in felt]
        message = Contacts(tick=joints.tick, timestamp_ns=joints.timestamp_ns, contacts=contacts)
        return EstimatedContacts(message, [one.confidence for one in felt])

    def _contact(self, felt: FeltContact) -> Contact:
        """At the skin of its link, where the push comes from."""
        normal = np.array(felt.normal_l)
        position = np.array([felt.along_m, 0.0, 0.0]) - self._robot.links[felt.link].radius_m * normal
        along, across = tangents(felt.normal_l)
        return Contact(
            link=felt.link,
            obstacle=None,
            position_l=tuple(position.tolist()),
            normal_l=felt.normal_l,
            tangent_1_l=along,
            tangent_2_l=across,
            force_l=tuple((felt.force_n * normal).tolist()),
            torque_l=(0.0, 0.0, 0.0),
        )


def with_estimated(world: World, estimated: EstimatedContacts) -> World:
    """The world made with estimated contacts, which says so. On a known map a push where no obstacle is, is noise."""
    contacts = [
        msgspec.structs.replace(contact, confidence=confidence)
        for contact, confidence in zip(world.contacts, estimated.confidence, strict=True)
        if contact.obstacle is not None
    ]
    return msgspec.structs.replace(world, contacts=contacts, contacts_from="joint_torques")
