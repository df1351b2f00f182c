"""The pose of a robot that nobody watches: dead reckoning from its start, held by the obstacles it touches.

By joints and contacts. IMUs are not used: with the few readings that come over a bus, runs got lost.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from snakesim_gnc.guidance.anchoring import ESTIMATED, MEASURED, Anchors
from snakesim_gnc.guidance.body_history import Base
from snakesim_gnc.guidance.localization import Localizer, PoseNoise
from snakesim_gnc.guidance.perceived_world import confidence_of, quaternion_of
from snakesim_hal.wire.messages import Contacts, Description, JointState, Obstacle, Pose, World


class ReckonedPose:
    """Joint states in, with what is felt; poses out."""

    def __init__(self, robot: Description, start: Base, known: Sequence[Obstacle]) -> None:
        """start: where it is laid down. known: the surveyed obstacles."""
        self._localizer = Localizer(robot, start, PoseNoise())
        self._anchors = Anchors(robot, known)
        self._timestamp_ns = -1

    def move(self, joints: JointState, contacts: Contacts | None, *, estimated: bool) -> Pose:
        """The pose at a joint state; one that is not newer changes nothing. estimated: nobody measures the contacts."""
        here = self._localizer
        if joints.timestamp_ns > self._timestamp_ns and all(joints.valid):
            self._timestamp_ns = joints.timestamp_ns
            here.move(joints, contacts, None)
            felt = [] if contacts is None else contacts.contacts
            self._anchors.hold(here, np.array(joints.angle_rad), felt, ESTIMATED if estimated else MEASURED)
        return Pose(
            tick=joints.tick,
            timestamp_ns=joints.timestamp_ns,
            position_w=tuple(here.base.position_w.tolist()),
            orientation_wxyz=quaternion_of(here.base.rotation),
            velocity_w=(0.0, 0.0, 0.0),
            angular_velocity_w=(0.0, 0.0, 0.0),
        )

    def told_in(self, world: World) -> World:
        """The world made with that pose, which says how sure it is, and that nobody has measured it."""
        sd_m = min(self._localizer.position_sd_m, 1e3)
        return msgspec.structs.replace(
            world,
            base_confidence=confidence_of(sd_m),
            pose_timestamp_ns=None,
            base_position_sd_m=sd_m,
            base_yaw_sd_rad=min(self._localizer.yaw_sd_rad, 10.0),
            pose_from="dead_reckoning",
        )
