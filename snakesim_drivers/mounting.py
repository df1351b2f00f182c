"""Between joints and the shafts of their drives: sign, zero and gear of every joint, as vectors.

    drive angle    = zero_rad + sign * gear * joint angle
    drive velocity = sign * gear * joint velocity
    drive torque   = joint torque / (sign * gear)           friction of the gear is the motor's `friction_nm`

A driver speaks to its drives in the numbers on the left, and to everybody else in those on the right. All vectors are
(n_joints,) float64, tail to head. With sign 1, zero 0 and gear 1 they are the same, to the bit.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Drive, Joint
from snakesim_hal.wire.messages import Mode


class Mounting:
    """How all drives of a robot are mounted, as its file says."""

    def __init__(self, joints: Sequence[Joint]) -> None:
        """joints: `RobotFile.joint_table`, or those that one bus has."""
        self.sign: Floats = np.array([float(joint.drive.sign) for joint in joints])
        self.zero_rad: Floats = np.array([joint.drive.zero_rad for joint in joints])
        self.gear: Floats = np.array([joint.drive.gear for joint in joints])
        self._turns = self.sign * self.gear

    # --- to the drive ----------------------------------------------------------------------------------------

    def drive_angle_rad(self, joint_angle_rad: Floats) -> Floats:
        """Angles of the drives' shafts."""
        return self.zero_rad + self._turns * joint_angle_rad

    def drive_velocity_rad_s(self, joint_velocity_rad_s: Floats) -> Floats:
        """Velocities of the drives' shafts."""
        return self._turns * joint_velocity_rad_s

    def drive_torque_nm(self, joint_torque_nm: Floats) -> Floats:
        """Torques at the drives' shafts."""
        return joint_torque_nm / self._turns

    def drive_targets(self, modes: Sequence[Mode], targets: Sequence[float]) -> Floats:
        """SafeSetpoints in the unit of each joint's mode; of a passive joint 0."""
        mode, target = np.array(modes, dtype=np.intp), np.array(targets)
        choices = (
            np.zeros(len(target)),
            self.drive_angle_rad(target),
            self.drive_velocity_rad_s(target),
            self.drive_torque_nm(target),
        )
        return np.choose(mode, choices)

    def drive_torque_limit_nm(self, joint_limit_nm: Floats) -> Floats:
        """Limits, which have no sign."""
        return joint_limit_nm / self.gear

    # --- from the drive --------------------------------------------------------------------------------------

    def joint_angle_rad(self, drive_angle_rad: Floats) -> Floats:
        """Angles of the joints."""
        return (drive_angle_rad - self.zero_rad) / self._turns

    def joint_velocity_rad_s(self, drive_velocity_rad_s: Floats) -> Floats:
        """Velocities of the joints."""
        return drive_velocity_rad_s / self._turns

    def joint_torque_nm(self, drive_torque_nm: Floats) -> Floats:
        """Torques at the joints."""
        return drive_torque_nm * self._turns


def joint_target(drive: Drive, mode: Mode, target: float) -> float:
    """What a target of a module's shaft is at the joint, in the mode's unit."""
    turns = drive.sign * drive.gear
    match mode:
        case Mode.POSITION:
            return (target - drive.zero_rad) / turns
        case Mode.VELOCITY:
            return target / turns
        case Mode.TORQUE:
            return target * turns
        case Mode.PASSIVE:
            return 0.0
