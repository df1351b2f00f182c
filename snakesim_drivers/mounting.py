"""Converts between joints and the shafts of their drives: sign, zero and gear of every joint, as vectors.

    drive angle    = zero_rad + sign * gear * joint angle
    drive velocity = sign * gear * joint velocity
    drive torque   = joint torque / (sign * gear)

Friction of the gear is not here: it is the motor's `friction_nm`. A driver exchanges the values on the left with its
drives, and those on the right with the rest of SnakeSIM. All vectors are (n_joints,) float64, from tail to head. With
sign 1, zero 0 and gear 1 both are the same, to the bit.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint, JointDrive
from snakesim_hal.wire.messages import JointMode


class DriveMounting:
    """How the drives of some joints are mounted, as the robot file describes it."""

    def __init__(self, joints: Sequence[Joint]) -> None:
        """Read sign, zero and gear of every joint.

        Args:
            joints: All joints of a robot, or those of one bus, from tail to head.
        """
        self.sign: Floats = np.array([float(joint.drive.sign) for joint in joints])
        self.zero_rad: Floats = np.array([joint.drive.zero_rad for joint in joints])
        self.gear: Floats = np.array([joint.drive.gear for joint in joints])
        self._ratio = self.sign * self.gear  # revolutions of the shaft for one of the joint

    # --- from joints to drives --------------------------------------------------------------------------------

    def to_drive_angle_rad(self, joint_angle_rad: Floats) -> Floats:
        """Return the angles of the drives' shafts in rad for joint angles in rad, (n_joints,)."""
        return self.zero_rad + self._ratio * joint_angle_rad

    def to_drive_velocity_rad_s(self, joint_velocity_rad_s: Floats) -> Floats:
        """Return the velocities of the drives' shafts in rad/s for joint velocities in rad/s, (n_joints,)."""
        return self._ratio * joint_velocity_rad_s

    def to_drive_torque_nm(self, joint_torque_nm: Floats) -> Floats:
        """Return the torques at the drives' shafts in N·m for joint torques in N·m, (n_joints,)."""
        return joint_torque_nm / self._ratio

    def to_drive_torque_limit_nm(self, joint_limit_nm: Floats) -> Floats:
        """Return the torque limits at the drives' shafts in N·m for those of joints in N·m. Limits have no sign."""
        return joint_limit_nm / self.gear

    def to_drive_targets(self, modes: Sequence[JointMode], targets: Sequence[float]) -> Floats:
        """Convert targets of joints to targets of the drives' shafts.

        Args:
            modes: Mode of every joint.
            targets: Target of every joint in rad, rad/s or N·m, by its mode.

        Returns:
            Targets of the shafts in the same units, (n_joints,); 0 for passive joints.
        """
        mode_numbers = np.array(modes, dtype=np.intp)  # indices into `target_by_mode`
        joint_targets = np.array(targets)
        target_by_mode = (
            np.zeros(len(joint_targets)),
            self.to_drive_angle_rad(joint_targets),
            self.to_drive_velocity_rad_s(joint_targets),
            self.to_drive_torque_nm(joint_targets),
        )
        return np.choose(mode_numbers, target_by_mode)

    # --- from drives to joints --------------------------------------------------------------------------------

    def to_joint_angle_rad(self, drive_angle_rad: Floats) -> Floats:
        """Return the joint angles in rad for angles of the drives' shafts in rad, (n_joints,)."""
        return (drive_angle_rad - self.zero_rad) / self._ratio

    def to_joint_velocity_rad_s(self, drive_velocity_rad_s: Floats) -> Floats:
        """Return the joint velocities in rad/s for velocities of the drives' shafts in rad/s, (n_joints,)."""
        return drive_velocity_rad_s / self._ratio

    def to_joint_torque_nm(self, drive_torque_nm: Floats) -> Floats:
        """Return the joint torques in N·m for torques at the drives' shafts in N·m, (n_joints,)."""
        return drive_torque_nm * self._ratio


def to_joint_target(drive: JointDrive, mode: JointMode, target: float) -> float:
    """Convert the target of one drive's shaft to that of its joint.

    Args:
        drive: Sign, zero and gear of the drive.
        mode: Mode of the target.
        target: Target at the shaft in rad, rad/s or N·m, by the mode.

    Returns:
        Target at the joint in the same unit; 0 for a passive joint.
    """
    ratio = drive.sign * drive.gear
    match mode:
        case JointMode.POSITION:
            return (target - drive.zero_rad) / ratio
        case JointMode.VELOCITY:
            return target / ratio
        case JointMode.TORQUE:
            return target * ratio
        case JointMode.PASSIVE:
            return 0.0
