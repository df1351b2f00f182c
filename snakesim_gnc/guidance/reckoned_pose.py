"""The pose of a robot without a pose sensor: dead reckoning from its start, corrected by the obstacles it touches.

It uses joints and contacts, and no IMU: with the few IMU readings that come over a bus, the pose got lost.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from snakesim_gnc.guidance.anchoring import ESTIMATED, MEASURED, Anchors
from snakesim_gnc.guidance.body_history import Base
from snakesim_gnc.guidance.localization import Localizer, PoseNoise
from snakesim_gnc.guidance.perceived_world import compute_confidence, quaternion_from_rotation
from snakesim_hal.wire.messages import Contacts, Description, JointState, Obstacle, Pose, World

MAX_POSITION_SD_M = 1e3  # upper limits of what is reported
MAX_YAW_SD_RAD = 10.0


class ReckonedPose:
    """Computes poses from joint states and contacts."""

    def __init__(self, robot: Description, start: Base, known: Sequence[Obstacle]) -> None:
        """Begin at the start pose. known: the surveyed obstacles."""
        self._localizer = Localizer(robot, start, PoseNoise())
        self._anchors = Anchors(robot, known)
        self._timestamp_ns = -1

    def move(self, joints: JointState, contacts: Contacts | None, *, estimated: bool) -> Pose:
        """Return the pose at a joint state. A joint state that is not newer changes nothing.

        estimated: whether the contacts are estimated rather than measured.
        """
        localizer = self._localizer
        if joints.timestamp_ns > self._timestamp_ns and all(joints.valid):
            self._timestamp_ns = joints.timestamp_ns
            localizer.move(joints, contacts, None)
            self._anchors.hold(
                localizer,
                np.array(joints.angle_rad),
                [] if contacts is None else contacts.contacts,
                ESTIMATED if estimated else MEASURED,
            )
        return Pose(
            tick=joints.tick,
            timestamp_ns=joints.timestamp_ns,
            position_w=tuple(localizer.base.position_w.tolist()),
            orientation_wxyz=quaternion_from_rotation(localizer.base.rotation),
            velocity_w=(0.0, 0.0, 0.0),
            angular_velocity_w=(0.0, 0.0, 0.0),
        )

    def mark_reckoned(self, world: World) -> World:
        """Return a world made with this pose, marked as dead-reckoned, with the uncertainty of the pose."""
        position_sd_m = min(self._localizer.position_sd_m, MAX_POSITION_SD_M)
        return msgspec.structs.replace(
            world,
            base_confidence=compute_confidence(position_sd_m),
            pose_timestamp_ns=None,
            base_position_sd_m=position_sd_m,
            base_yaw_sd_rad=min(self._localizer.yaw_sd_rad, MAX_YAW_SD_RAD),
            pose_from="dead_reckoning",
        )
