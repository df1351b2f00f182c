"""The pose of a robot without a pose sensor: dead reckoning from its start, corrected by the obstacles it touches.

It uses joints and contacts, and no IMU: with the few IMU readings that come over a bus, the pose got lost.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from snakesim_gnc.guidance.pose.anchoring import (
    ESTIMATED_CONTACT_TRUST,
    MEASURED_CONTACT_TRUST,
    ObstacleAnchors,
)
from snakesim_gnc.guidance.pose.body_history import BasePose
from snakesim_gnc.guidance.pose.localization import PoseLocalizer, PoseNoise, compute_confidence
from snakesim_hal.model.geometry.kinematics import quaternion_from_rotation
from snakesim_hal.wire.messages import (
    Contacts,
    JointState,
    KnownObstacle,
    Pose,
    RobotDescription,
    WorldModel,
)

MAX_POSITION_SD_M = 1e3  # upper limits of what is reported
MAX_YAW_SD_RAD = 10.0


class DeadReckonedPose:
    """Computes poses from joint states and contacts."""

    def __init__(
        self, robot: RobotDescription, start: BasePose, known_obstacles: Sequence[KnownObstacle]
    ) -> None:
        """Create a dead-reckoned pose that starts at a known pose.

        Args:
            robot: Description of the robot.
            start: Base pose at the start.
            known_obstacles: The surveyed obstacles, against which contacts correct the pose.
        """
        self._localizer = PoseLocalizer(robot, start, PoseNoise())
        self._anchors = ObstacleAnchors(robot, known_obstacles)
        self._timestamp_ns = -1

    def update(
        self, joints: JointState, contacts: Contacts | None, *, are_contacts_estimated: bool
    ) -> Pose:
        """Update the dead-reckoned base pose by a joint state, and return it.

        The odometry moves the pose, and contacts with known obstacles correct it. A joint state that is not newer than
        the last one, or not valid for every joint, changes nothing.

        Args:
            joints: The newest joint state.
            contacts: Contacts of the links; None if they are unknown.
            are_contacts_estimated: Whether the contacts are estimated rather than measured.
        """
        localizer = self._localizer
        is_new = joints.timestamp_ns > self._timestamp_ns
        if is_new and all(joints.valid):
            self._timestamp_ns = joints.timestamp_ns
            localizer.predict(joints, contacts, None)
            contact_list = [] if contacts is None else contacts.contacts
            trust = ESTIMATED_CONTACT_TRUST if are_contacts_estimated else MEASURED_CONTACT_TRUST
            self._anchors.correct_pose(localizer, np.array(joints.angle_rad), contact_list, trust)
        return Pose(
            tick=joints.tick,
            timestamp_ns=joints.timestamp_ns,
            position_w=tuple(localizer.base.position_w.tolist()),
            orientation_wxyz=quaternion_from_rotation(localizer.base.rotation),
            velocity_w=(0.0, 0.0, 0.0),
            angular_velocity_w=(0.0, 0.0, 0.0),
        )

    def mark_dead_reckoned(self, world: WorldModel) -> WorldModel:
        """Return a copy of a world model that is marked as dead-reckoned, with the uncertainty of the pose."""
        position_sd_m = min(self._localizer.position_sd_m, MAX_POSITION_SD_M)
        return msgspec.structs.replace(
            world,
            base_confidence=compute_confidence(position_sd_m),
            pose_timestamp_ns=None,
            base_position_sd_m=position_sd_m,
            base_yaw_sd_rad=min(self._localizer.yaw_sd_rad, MAX_YAW_SD_RAD),
            pose_from="dead_reckoning",
        )
