"""Passes the demand of an emulated drive, which is given at its shaft, on to the motor of its joint."""

from snakesim_drivers.mounting import to_joint_target
from snakesim_hal.model.robot_file.joints import JointDrive
from snakesim_hal.physics.motors import PowerStages
from snakesim_hal.wire.messages import JointMode


def set_shaft_demand(
    motors: PowerStages,
    joint_index: int,
    drive: JointDrive,
    torque_ratio: float,
    *,
    mode: JointMode,
    target: float,
    torque_limit_nm: float,
    stiffness: float,
    damping: float,
    speed_limit_rad_s: float,
) -> None:
    """Set the demand of a drive, converted from its shaft to its joint.

    Args:
        motors: The motors of all joints.
        joint_index: Index of the drive's joint, from 0 at the tail.
        drive: Sign, zero and gear of the drive.
        torque_ratio: Real torque of the drive divided by the torque that it computes from its current.
        mode: Control mode of the motor.
        target: Target in rad, rad/s or N·m, by the mode.
        torque_limit_nm: Torque limit.
        stiffness: Gain of position mode in N·m/rad.
        damping: Gain of position and velocity mode in N·m·s/rad.
        speed_limit_rad_s: Speed limit.
    """
    # Revolutions of the shaft for one of the joint, so torques at the joint are higher by it.
    gear = drive.gear
    joint_target = to_joint_target(drive, mode, target)
    if mode == JointMode.TORQUE:
        joint_target *= torque_ratio
    motors.set_demand(
        joint_index,
        mode,
        joint_target,
        torque_limit_nm * gear * torque_ratio,
        stiffness * gear**2 * torque_ratio,
        damping * gear**2 * torque_ratio,
        speed_limit_rad_s / gear,
    )
