"""The motor model of a joint, as shared by simulator, emulated joint modules and the checks before a run.

A joint's torque follows its demand as a first-order lag, is clipped to a limit, and falls to 0 at the speed limit.
"""

import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.robot import Module, RobotFile

STEEPEST_ROLL_OFF = 10.0  # full torque up to 1 - 1/10 of the speed limit, falling to 0 at it


def roll_off(joint: Joint, module: Module, step_s: float) -> float:
    """Slope of the torque at the speed limit: less than `STEEPEST_ROLL_OFF` if the time step cannot resolve that.

    The roll-off acts on the rotor as a damper behind the motor's lag, which explicit steps can only integrate up to a
    certain strength.
    """
    motor, limits = joint.motor, joint.limits
    inertia_kg_m2 = motor.armature_kg_m2 + module.mass_kg * module.length_m**2 / 12
    strongest_nm_s = inertia_kg_m2 / step_s * max(min(motor.response_time_s / step_s, 1e3), 0.5)
    return float(np.clip(strongest_nm_s * limits.speed_rad_s / limits.torque_nm, 1.0, STEEPEST_ROLL_OFF))


def check_gains(robot: RobotFile) -> None:
    """Raise ConfigError for an unstable position mode, by Routh's criterion for a lagging PD loop."""
    for joint in robot.joint_table:
        motor = joint.motor
        least = motor.stiffness_nm_per_rad * motor.response_time_s
        damping = motor.damping_nm_s_per_rad + motor.viscous_nm_s_per_rad
        if damping <= least and least > 0:
            raise ConfigError(
                f"robot {robot.name!r}, {joint.name}: position mode is unstable: a motor with "
                f"`motor.response_time_s` = {motor.response_time_s} s with `motor.stiffness_nm_per_rad` = "
                f"{motor.stiffness_nm_per_rad} N·m/rad needs `motor.damping_nm_s_per_rad` above {least:g} N·m·s/rad; "
                f"it is {motor.damping_nm_s_per_rad}"
            )
