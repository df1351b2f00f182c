"""The world model on a known map: body pose, contacts in the world frame, and obstacles near the body. Pure."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_link_frames, rotation_from_quaternion
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import (
    Contact,
    Contacts,
    JointState,
    KnownObstacle,
    Pose,
    RobotDescription,
    WorldContact,
    WorldModel,
)

# Confidence in a pose falls to 1/e after this time without a new one.
POSE_CONFIDENCE_DECAY_TIME_S = 0.5
MAX_CONTACT_GAP_M = 0.03  # a contact farther from every known obstacle belongs to none


class SurveyedWorld:
    """Makes world models from the newest sample of each sensor."""

    def __init__(
        self,
        robot: RobotDescription,
        known_obstacles: Sequence[KnownObstacle],
        *,
        map_radius_m: float = 0.5,
    ) -> None:
        """Prepare to make world models of a robot among surveyed obstacles.

        Args:
            robot: Description of the robot.
            known_obstacles: The surveyed obstacles.
            map_radius_m: Distance from the robot up to which obstacles are part of the published world model.
        """
        # The robot.
        self._axes = [joint.axis for joint in robot.joints]
        self._lengths_m = [link.length_m for link in robot.links]
        self._half_lengths_m = 0.5 * np.array(self._lengths_m)
        self._link_rear_s_m = np.concatenate(([0.0], np.cumsum(self._lengths_m)))[:-1]
        masses_kg = np.array([link.mass_kg for link in robot.links])
        self._mass_fractions = masses_kg / masses_kg.sum()
        # The map.
        self._known_obstacles = list(known_obstacles)
        self._outlines = ObstacleOutlines.from_obstacles(known_obstacles)
        self._obstacle_x = np.ascontiguousarray(self._outlines.center_w[:, 0])
        self._obstacle_y = np.ascontiguousarray(self._outlines.center_w[:, 1])
        self._map_radius_m = map_radius_m

    def update(
        self, tick: int, now_ns: int, joints: JointState, contacts: Contacts | None, pose: Pose
    ) -> WorldModel:
        """Compute the world model from the newest samples, with contacts and center of mass in the world frame.

        Args:
            tick: Tick of the clock.
            now_ns: Robot time of the clock. The confidence decreases with the age of the pose.
            joints: The newest joint state; the world model gets the timestamp of this sample.
            contacts: Contacts in the frames of the links; None if there is no contact sensor.
            pose: Pose of the base from its sensor.

        Returns:
            The world model.
        """
        rotation = rotation_from_quaternion(pose.orientation_wxyz)
        link_origins_w, rotations = compute_link_frames(
            pose.position_w, rotation, joints.angle_rad, self._axes, self._lengths_m
        )
        link_centers_w = link_origins_w + self._half_lengths_m[:, None] * rotations[:, :, 0]
        pose_age_s = max(now_ns - pose.timestamp_ns, 0) * 1e-9
        return WorldModel(
            tick=tick,
            timestamp_ns=joints.timestamp_ns,
            base_position_w=pose.position_w,
            base_orientation_wxyz=pose.orientation_wxyz,
            base_confidence=math.exp(-pose_age_s / POSE_CONFIDENCE_DECAY_TIME_S),
            contacts=self._transform_contacts(contacts, link_origins_w, rotations),
            obstacles=self._find_obstacles_near_body(link_origins_w),
            pose_timestamp_ns=pose.timestamp_ns,
            pose_from="sensor",
            contacts_timestamp_ns=None if contacts is None else contacts.timestamp_ns,
            contacts_from=None if contacts is None else "sensor",
            center_w=tuple((self._mass_fractions @ link_centers_w).tolist()),
        )

    def _transform_contacts(
        self, contacts: Contacts | None, origins_w: Floats, rotations: Floats
    ) -> list[WorldContact]:
        """Transform the contacts from the frames of their links into the world.

        Args:
            contacts: Contacts of the links; None if there is no contact sensor.
            origins_w: (n, 3) rear ends of the n links in the world, m.
            rotations: (n, 3, 3) rotation matrices world_from_link.

        Returns:
            The contacts in the world; an empty list without a contact sensor.
        """
        if contacts is None:
            return []
        return [
            transform_contact(
                contact,
                origins_w,
                rotations,
                self._link_rear_s_m,
                partial(self._name_obstacle, contact.obstacle),
            )
            for contact in contacts.contacts
            if contact.link < len(origins_w)
        ]

    def _name_obstacle(self, sensor_name: str | None, position_w: Floats) -> str | None:
        """Return the obstacle's name that the sensor gave, or else that of the known obstacle at a position (3,)."""
        return sensor_name or self._find_obstacle_at(position_w)

    def _find_obstacle_at(self, position_w: Floats) -> str | None:
        """Return the name of the known obstacle at a position (3,); None if none is within MAX_CONTACT_GAP_M."""
        if not self._known_obstacles:
            return None
        gaps_m = self._outlines.compute_distances_m(position_w[:2])
        nearest_index = int(np.argmin(gaps_m))
        if gaps_m[nearest_index] < MAX_CONTACT_GAP_M:
            return self._known_obstacles[nearest_index].name
        return None

    def _find_obstacles_near_body(self, origins_w: Floats) -> list[KnownObstacle]:
        """Return the known obstacles within the map radius of the links' origins (n, 3)."""
        # One array for each coordinate, (obstacles, n). An array of points would take twice as long.
        difference_x = self._obstacle_x[:, None] - origins_w[:, 0]
        difference_y = self._obstacle_y[:, None] - origins_w[:, 1]
        distances_m = np.hypot(difference_x, difference_y)
        gaps_m = distances_m.min(axis=1) - self._outlines.bounding_radius_m
        return [
            self._known_obstacles[index] for index in np.flatnonzero(gaps_m < self._map_radius_m)
        ]


def transform_contact(
    contact: Contact,
    origins_w: Floats,
    rotations: Floats,
    link_rear_s_m: Floats,
    find_name: Callable[[Floats], str | None],
) -> WorldContact:
    """Transform a contact from the frame of its link into the world.

    Args:
        contact: The contact, in the frame of its link.
        origins_w: (n, 3) rear ends of all n links in the world, m.
        rotations: (n, 3, 3) rotation matrices world_from_link of all links.
        link_rear_s_m: (n,) arc length along the body of each link's rear.
        find_name: Returns the name of the obstacle at a position (3,) in the world.
    """
    rotation = rotations[contact.link]
    vectors_l = np.array(
        [contact.position_l, contact.normal_l, contact.tangent_1_l, contact.force_l]
    )
    from_origin_w, normal_w, tangent_w, force_w = vectors_l @ rotation.T
    position_w = from_origin_w + origins_w[contact.link]
    return WorldContact(
        link=contact.link,
        obstacle=find_name(position_w),
        body_s_m=float(link_rear_s_m[contact.link]) + contact.position_l[0],
        position_w=tuple(position_w.tolist()),
        normal_w=tuple(normal_w.tolist()),
        tangent_w=tuple(tangent_w.tolist()),
        force_w=tuple(force_w.tolist()),
    )
