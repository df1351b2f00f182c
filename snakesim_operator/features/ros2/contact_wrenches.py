"""Contact forces of the links as geometry_msgs/WrenchStamped."""

from collections.abc import Iterable

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Contact, Contacts
from snakesim_operator.features.ros2 import messages as ros


def sum_wrenches(contacts: Iterable[Contact], link_count: int) -> Floats:
    """Sum the contact forces on each link, (links, 6): force in N and torque in N·m, in the link's frame.

    Obstacles exert these on the link. The torque is about the origin of the frame:

        force = sum of f_i,  torque = sum of (p_i x f_i + t_i)

    Args:
        contacts: The contacts at one time. Those of links that the robot does not have are ignored.
        link_count: Number of links.
    """
    wrenches = np.zeros((link_count, 6))
    for contact in contacts:
        if contact.link < link_count:
            force_n = np.asarray(contact.force_l)
            wrenches[contact.link, :3] += force_n
            wrenches[contact.link, 3:] += np.cross(contact.position_l, force_n) + np.asarray(
                contact.torque_l
            )
    return wrenches


def encode_wrenches(timestamp_ns: int, frames: list[str], sample: Contacts) -> list[bytes]:
    """Encode the contacts as one geometry_msgs/WrenchStamped in CDR for each link, also for links without contact.

    Args:
        timestamp_ns: Time of the sample.
        frames: Frame of each link, tail to head.
        sample: The contacts of all links.
    """
    encoded: list[bytes] = []
    for frame, wrench in zip(
        frames, sum_wrenches(sample.contacts, len(frames)).tolist(), strict=True
    ):
        fx, fy, fz, tx, ty, tz = wrench
        force_and_torque = ros.make_message(
            "geometry_msgs/msg/Wrench", ros.make_vector((fx, fy, fz)), ros.make_vector((tx, ty, tz))
        )
        encoded.append(
            ros.encode_message(ros.WRENCH, ros.make_header(timestamp_ns, frame), force_and_torque)
        )
    return encoded
