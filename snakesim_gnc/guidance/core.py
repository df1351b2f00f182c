"""The world model: body pose, contacts in the world frame, and the known obstacles near the body. Pure."""

import math
from collections.abc import Sequence

import numpy as np

from snakesim_gnc.guidance.contacts_w import contact_w
from snakesim_hal.model.kinematics import link_frames, rotation_from_quaternion
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import (
    Contacts,
    Description,
    JointState,
    Obstacle,
    Pose,
    World,
)

POSE_MEMORY_S = 0.5  # confidence in a pose falls to 1/e after this long without a new one


class WorldModel:
    """Turns the newest sample of each sensor into a World."""

    def __init__(self, robot: Description, known: Sequence[Obstacle], *, reach_m: float = 0.5) -> None:
        """known: the surveyed obstacles; only those within `reach_m` of the body are passed on."""
        self._axes = [joint.axis for joint in robot.joints]
        self._lengths = [link.length_m for link in robot.links]
        self._rear_s = np.concatenate(([0.0], np.cumsum(self._lengths)))[:-1]
        self._known = list(known)
        self._outlines = Outlines.of(known)
        self._reach_m = reach_m
        masses = np.array([link.mass_kg for link in robot.links])
        self._shares = masses / masses.sum()
        self._half_m = 0.5 * np.array(self._lengths)

    def update(self, tick: int, now_ns: int, joints: JointState, contacts: Contacts | None, pose: Pose) -> World:
        """The world from the newest samples, whose own stamps it carries. tick, now_ns: of the clock."""
        rotation = rotation_from_quaternion(pose.orientation_wxyz)
        origins, rotations = link_frames(pose.position_w, rotation, joints.angle_rad, self._axes, self._lengths)
        felt = [] if contacts is None else contacts.contacts
        age_s = max(now_ns - pose.timestamp_ns, 0) * 1e-9
        middles = origins + self._half_m[:, None] * rotations[:, :, 0]
        return World(
            tick=tick,
            timestamp_ns=joints.timestamp_ns,
            base_position_w=pose.position_w,
            base_orientation_wxyz=pose.orientation_wxyz,
            base_confidence=math.exp(-age_s / POSE_MEMORY_S),
            contacts=[
                contact_w(c, origins, rotations, self._rear_s, lambda at, c=c: c.obstacle or self._touching(at))
                for c in felt
                if c.link < len(origins)
            ],
            obstacles=self._obstacles_nearby(origins),
            pose_timestamp_ns=pose.timestamp_ns,
            pose_from="sensor",
            contacts_timestamp_ns=None if contacts is None else contacts.timestamp_ns,
            contacts_from=None if contacts is None else "sensor",
            center_w=tuple((self._shares @ middles).tolist()),
        )

    def _touching(self, position_w: np.ndarray) -> str | None:
        """The known obstacle at a contact, for sensors that do not identify it."""
        if not self._known:
            return None
        gaps = self._outlines.distance_m(position_w[:2])
        nearest = int(np.argmin(gaps))
        return self._known[nearest].name if gaps[nearest] < 0.03 else None

    def _obstacles_nearby(self, origins: np.ndarray) -> list[Obstacle]:
        x, y = (self._outlines.center_w[:, None] - origins[:, :2]).transpose(2, 0, 1)
        gaps = np.hypot(x, y).min(axis=1) - self._outlines.reach_m
        return [self._known[i] for i in np.flatnonzero(gaps < self._reach_m)]
