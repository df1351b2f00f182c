"""Steers the front of the body, ahead of all contacts that push, back onto the path.

Joint angles alone do not lead a body back: if the body is turned a little against its path, every angle is right and
the head is still beside the path. So the links ahead of the foremost pushing contact get headings that depend on their
positions:

    psi_k = psi_k(s) - atan(e_k / correction_m)

    psi_k(s)    heading of link k of the body on the path, with its tail at the arc length s
    e_k         distance to the left of the path of the point where link k begins

The joints between these links carry no contact force, so they can be in position mode, as stiff as the drives are.
"""

import numpy as np

from snakesim_gnc.control.obstacle_aided.push import PushSnapshot
from snakesim_gnc.control.progress import BodyLocation
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription

MAX_FRONT_JOINTS = 5
MIN_FORCE_RATIO = 0.1  # of the largest contact force: a contact with less does not push
MAX_CORRECTION_RAD = 0.5  # of one joint
MAX_CORRECTION_RAD_S = 2.5
# Of a joint in position mode behind its moving target, with the delays of sensor and command.
POSITION_LAG_S = 0.05


class FrontSteering:
    """Finds the joints ahead of all pushing contacts, and the targets that lead them back to the path.

    Attributes:
        joints: Indices of these joints, tail to head.
        corrections_rad: (n_joints,) angles that are added to those of the body on its path.
    """

    def __init__(
        self, robot: RobotDescription, body: PlanarBody, *, correction_m: float, blend_s: float
    ) -> None:
        """Start with all joints on the path.

        Args:
            robot: Description of the robot.
            body: The same robot as a planar chain.
            correction_m: Distance over which the front returns to its path; 0 for no steering at all.
            blend_s: Time in which the torque of a joint fades out that becomes part of the front.
        """
        self._body = body
        self._correction_m = correction_m
        self._blend_s = blend_s
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._damping = np.array([joint.damping_nm_s_per_rad for joint in robot.joints])
        self.joints: list[int] = []
        self.corrections_rad = np.zeros(len(robot.joints))
        # With the target of a joint that has just become part of the front, its drive keeps its torque.
        self._target_offsets_rad = np.zeros(len(robot.joints))
        # Joints that had a target at the last update.
        self._led_joints: set[int] = set()
        self._last_time_s = -np.inf

    def update(
        self, location: BodyLocation, snapshot: PushSnapshot | None, period_s: float
    ) -> None:
        """Find the front of the body at this tick, and change the corrections at a limited rate.

        Args:
            location: The body on its path.
            snapshot: Contacts of the body, and the push that they allow; None if they are not known.
            period_s: Time since the last update.
        """
        if self._correction_m == 0.0:
            return
        yaw_joints = self._body.yaw_joints
        first = self._find_first_bend(snapshot)
        wanted_rad = np.zeros(len(self.corrections_rad))
        on_path = location.body_on_path.compute_pose_at(location.tail_s_at_pose_m)
        wanted_rad[yaw_joints] = compute_front_corrections_rad(
            location.body_points_w, on_path.body_points_w, first, self._correction_m
        )
        wanted_rad = np.clip(wanted_rad, -MAX_CORRECTION_RAD, MAX_CORRECTION_RAD)
        max_change_rad = MAX_CORRECTION_RAD_S * period_s
        self.corrections_rad = self.corrections_rad + np.clip(
            wanted_rad - self.corrections_rad, -max_change_rad, max_change_rad
        )
        self.joints = yaw_joints[first:]

    def compute_targets_rad(
        self, observation: Observation, reference_rad: Floats, velocity_rad_s: Floats
    ) -> dict[int, float]:
        """Compute the position targets of the front joints at this tick, without a jump of their torques.

        Args:
            observation: The inputs of this tick.
            reference_rad: (n_joints,) reference angles, corrections included.
            velocity_rad_s: (n_joints,) their derivatives by time.

        Returns:
            The target of each front joint, by its index.
        """
        if observation.time_s - self._last_time_s > 1.5 * observation.period_s:
            self._led_joints.clear()  # in the tick before, all joints were commanded in another way
        self._last_time_s = observation.time_s
        self._target_offsets_rad *= max(0.0, 1.0 - observation.period_s / self._blend_s)
        measured = observation.joints
        targets_rad: dict[int, float] = {}
        for i in self.joints:
            if i not in self._led_joints:
                load_nm = measured.torque_nm[i] + self._damping[i] * measured.velocity_rad_s[i]
                kept_target_rad = measured.angle_rad[i] + load_nm / self._stiffness[i]
                self._target_offsets_rad[i] = kept_target_rad - reference_rad[i]
            lead_rad = velocity_rad_s[i] * POSITION_LAG_S
            targets_rad[i] = float(reference_rad[i] + lead_rad + self._target_offsets_rad[i])
        self._led_joints = set(self.joints)
        return targets_rad

    def _find_first_bend(self, snapshot: PushSnapshot | None) -> int:
        """Return the number of the rearmost joint that bends and that is ahead of all pushing contacts."""
        joint_count = len(self._body.yaw_joints)
        first = max(joint_count - MAX_FRONT_JOINTS, 1)
        if snapshot is None or not len(snapshot.contacts):
            return first
        forces = snapshot.push.contact_forces
        pushes = forces > MIN_FORCE_RATIO * forces.max()
        if not pushes.any():
            return first
        foremost_s_m = float(snapshot.contacts.body_s_m[pushes].max())
        return max(first, int(np.searchsorted(self._body.body_points_s_m[1:-1], foremost_s_m)))


def compute_front_corrections_rad(
    body_points_w: Floats, path_points_w: Floats, first_joint: int, correction_m: float
) -> Floats:
    """Compute by how much the joints at the front must turn further than on the path, to lead back to it.

    Args:
        body_points_w: (2, n_joints + 2) tail end, joints and head end of the measured body, m.
        path_points_w: (2, n_joints + 2) the same points of the body on its path.
        first_joint: Index of the rearmost joint that turns.
        correction_m: Distance over which the body returns to its path.

    Returns:
        (n_joints,) angles in rad that are added to those of the body on its path; 0 behind the first joint.
    """
    body_links_m = np.diff(body_points_w, axis=1)
    path_links_m = np.diff(path_points_w, axis=1)
    lengths_m = np.hypot(body_links_m[0], body_links_m[1])
    path_headings_rad = np.arctan2(path_links_m[1], path_links_m[0])
    corrections_rad = np.zeros(len(lengths_m) - 1)
    # By how much the last link is turned against the path, and where it ends.
    body_heading_rad = float(np.arctan2(body_links_m[1, first_joint], body_links_m[0, first_joint]))
    turned_rad = float(
        np.remainder(body_heading_rad - path_headings_rad[first_joint] + np.pi, 2 * np.pi) - np.pi
    )
    position_w = body_points_w[:, first_joint + 1]
    for joint in range(first_joint, len(corrections_rad)):
        link = joint + 1
        ahead = np.array([np.cos(path_headings_rad[link]), np.sin(path_headings_rad[link])])
        offset_w = position_w - path_points_w[:, link]
        left_m = float(ahead[0] * offset_w[1] - ahead[1] * offset_w[0])
        wanted_rad = -float(np.arctan2(left_m, correction_m))
        corrections_rad[joint] = wanted_rad - turned_rad
        turned_rad = wanted_rad
        heading_rad = path_headings_rad[link] + turned_rad
        position_w = position_w + lengths_m[link] * np.array(
            [np.cos(heading_rad), np.sin(heading_rad)]
        )
    return corrections_rad
