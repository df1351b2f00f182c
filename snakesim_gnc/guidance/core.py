"""The world model on a known map: body pose, contacts in the world frame, and obstacles near the body. Pure."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames, rotation_from_quaternion
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import (
    Contact,
    Contacts,
    Description,
    JointState,
    Obstacle,
    Pose,
    World,
    WorldContact,
)

POSE_MEMORY_S = 0.5  # confidence in a pose falls to 1/e after this time without a new one
MAX_CONTACT_GAP_M = 0.03  # a contact farther from every known obstacle belongs to none


class WorldModel:
    """Makes world models from the newest sample of each sensor."""

    def __init__(self, robot: Description, known: Sequence[Obstacle], *, reach_m: float = 0.5) -> None:
        """Create world models of a robot among surveyed obstacles.

        Args:
            robot: description of the robot.
            known: the surveyed obstacles.
            reach_m: distance from the robot up to which obstacles are part of the published world model.
        """
        # The robot.
        self._axes = [joint.axis for joint in robot.joints]
        self._lengths_m = [link.length_m for link in robot.links]
        self._half_m = 0.5 * np.array(self._lengths_m)
        self._rear_s_m = np.concatenate(([0.0], np.cumsum(self._lengths_m)))[:-1]
        masses_kg = np.array([link.mass_kg for link in robot.links])
        self._mass_ratios = masses_kg / masses_kg.sum()
        # The map.
        self._known = list(known)
        self._outlines = Outlines.from_obstacles(known)
        self._reach_m = reach_m

    def update(self, tick: int, now_ns: int, joints: JointState, contacts: Contacts | None, pose: Pose) -> World:
        """Compute the world model from the newest samples, with contacts and center of mass in the world frame.

        Args:
            tick: tick of the clock.
            now_ns: robot time of the clock. The confidence decreases with the age of the pose.
            joints: the newest joint state; the world model gets its timestamp.
            contacts: contacts in the frames of the links; None: there is no contact sensor.
            pose: pose of the base from its sensor.
        """
        rotation = rotation_from_quaternion(pose.orientation_wxyz)
        origins_w, rotations = link_frames(pose.position_w, rotation, joints.angle_rad, self._axes, self._lengths_m)
        middles_w = origins_w + self._half_m[:, None] * rotations[:, :, 0]
        pose_age_s = max(now_ns - pose.timestamp_ns, 0) * 1e-9
        return World(
            tick=tick,
            timestamp_ns=joints.timestamp_ns,
            base_position_w=pose.position_w,
            base_orientation_wxyz=pose.orientation_wxyz,
            base_confidence=math.exp(-pose_age_s / POSE_MEMORY_S),
            contacts=self._transform_contacts(contacts, origins_w, rotations),
            obstacles=self._find_obstacles_nearby(origins_w),
            pose_timestamp_ns=pose.timestamp_ns,
            pose_from="sensor",
            contacts_timestamp_ns=None if contacts is None else contacts.timestamp_ns,
            contacts_from=None if contacts is None else "sensor",
            center_w=tuple((self._mass_ratios @ middles_w).tolist()),
        )

    def _transform_contacts(
        self, contacts: Contacts | None, origins_w: Floats, rotations: Floats
    ) -> list[WorldContact]:
        """Return the contacts in the world. origins_w (n, 3), rotations (n, 3, 3) world_from_link: of the links."""
        if contacts is None:
            return []
        return [
            transform_contact(
                contact, origins_w, rotations, self._rear_s_m, partial(self._name_obstacle, contact.obstacle)
            )
            for contact in contacts.contacts
            if contact.link < len(origins_w)
        ]

    def _name_obstacle(self, sensor_name: str | None, position_w: Floats) -> str | None:
        """Return the name that the sensor gave, or else that of the known obstacle at a contact (3,)."""
        return sensor_name or self._find_touched(position_w)

    def _find_touched(self, position_w: Floats) -> str | None:
        """Return the name of the known obstacle at a position (3,), or None."""
        if not self._known:
            return None
        gaps_m = self._outlines.distance_m(position_w[:2])
        nearest = int(np.argmin(gaps_m))
        if gaps_m[nearest] < MAX_CONTACT_GAP_M:
            return self._known[nearest].name
        return None

    def _find_obstacles_nearby(self, origins_w: Floats) -> list[Obstacle]:
        """Return the known obstacles near the links' origins (n, 3)."""
        x, y = (self._outlines.center_w[:, None] - origins_w[:, :2]).transpose(2, 0, 1)
        gaps_m = np.hypot(x, y).min(axis=1) - self._outlines.reach_m
        return [self._known[index] for index in np.flatnonzero(gaps_m < self._reach_m)]


def transform_contact(
    contact: Contact,
    origins_w: Floats,
    rotations: Floats,
    rear_s_m: Floats,
    find_name: Callable[[Floats], str | None],
) -> WorldContact:
    """Return a contact of a link, transformed into the world.

    Args:
        contact: the contact, in the frame of its link.
        origins_w: (n, 3) rear ends of all n links in the world, m.
        rotations: (n, 3, 3) world_from_link of all links.
        rear_s_m: (n,) arc length along the body of each link's rear.
        find_name: returns the name of the obstacle at a position (3,) in the world.
    """
    rotation = rotations[contact.link]
    vectors_l = np.array([contact.position_l, contact.normal_l, contact.tangent_1_l, contact.force_l])
    from_origin_w, normal_w, tangent_w, force_w = vectors_l @ rotation.T
    position_w = from_origin_w + origins_w[contact.link]
    return WorldContact(
        link=contact.link,
        obstacle=find_name(position_w),
        body_s_m=float(rear_s_m[contact.link]) + contact.position_l[0],
        position_w=tuple(position_w.tolist()),
        normal_w=tuple(normal_w.tolist()),
        tangent_w=tuple(tangent_w.tolist()),
        force_w=tuple(force_w.tolist()),
    )
