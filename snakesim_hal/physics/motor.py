"""The motor model of a joint, as shared by the simulator, emulated joint modules and the checks before a run.

The torque of a joint follows its demand as a first-order lag, is clipped to a limit, and falls to 0 at the speed limit.
"""

import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import ModuleBody, RobotFile

# With this slope, full torque is available up to 9/10 of the speed limit, and none at the limit.
STEEPEST_ROLL_OFF = 10.0

# Bounds of the ratio of motor lag to time step for which the strength of a stable roll-off is computed.
MIN_LAG_STEPS = 0.5
MAX_LAG_STEPS = 1e3


def compute_torque_roll_off(joint: Joint, module: ModuleBody, step_s: float) -> float:
    """Compute how steeply the motor torque falls to 0 near the speed limit, in units of full torque per speed limit.

    The roll-off acts on the rotor as a damper behind the lag of the motor. Explicit steps can integrate such a damper
    only up to a certain strength, so the slope is less than `STEEPEST_ROLL_OFF` if the time step is too long for it.

    Args:
        joint: Joint with its limits, motor lag and rotor inertia.
        module: Joint module. The inertia of a link is estimated from its mass and length.
        step_s: Duration of a step of the physics model.

    Returns:
        The slope, from 1 (torque falls linearly from standstill on) to `STEEPEST_ROLL_OFF`.
    """
    motor = joint.motor
    limits = joint.limits
    inertia_kg_m2 = motor.armature_kg_m2 + module.mass_kg * module.length_m**2 / 12
    lag_steps = max(min(motor.response_time_s / step_s, MAX_LAG_STEPS), MIN_LAG_STEPS)
    max_damping_nm_s_per_rad = inertia_kg_m2 / step_s * lag_steps  # of a stable explicit step
    max_roll_off = max_damping_nm_s_per_rad * limits.speed_rad_s / limits.torque_nm
    return float(np.clip(max_roll_off, 1.0, STEEPEST_ROLL_OFF))


def validate_position_gains(robot: RobotFile) -> None:
    """Raise ConfigError unless position mode is stable for every joint.

    By Routh's criterion, a PD loop behind a first-order lag is stable if damping > stiffness * lag.

    Raises:
        ConfigError: The damping of a joint is too low for its stiffness and its lag.
    """
    for joint in robot.joint_table:
        motor = joint.motor
        # Both in N·m·s/rad.
        min_damping = motor.stiffness_nm_per_rad * motor.response_time_s
        damping = motor.damping_nm_s_per_rad + motor.viscous_nm_s_per_rad
        if damping <= min_damping and min_damping > 0:
            raise ConfigError(
                f"robot {robot.name!r}, {joint.name}: position mode is unstable: a motor with "
                f"`motor.response_time_s` = {motor.response_time_s} s with `motor.stiffness_nm_per_rad` = "
                f"{motor.stiffness_nm_per_rad} N·m/rad needs `motor.damping_nm_s_per_rad` above {min_damping:g} "
                f"N·m·s/rad; it is {motor.damping_nm_s_per_rad}",
                code="drive/unsupported-setting",
            )
