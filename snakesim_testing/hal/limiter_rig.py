"""Calls the command limiter with the limits of a robot with three joints."""

from typing import Any

import numpy as np

from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, MeasuredState
from snakesim_hal.safety.lease import CommandLease
from snakesim_hal.safety.limit_names import find_active_limits
from snakesim_hal.safety.limiter import compute_bumpless_target, limit_command
from snakesim_hal.wire.messages import JointCommand, JointMode
from snakesim_testing.hal.small_robots import make_description

ROBOT = make_description()
LIMITS = JointLimits.from_description(ROBOT)
JOINT_COUNT = len(ROBOT.joints)
PERIOD_S = 0.01
FULL_TORQUE = np.ones(JOINT_COUNT)  # no drive is derated
LEASE = CommandLease("control", 1, 100, 1000)
# The maximum changes of a target in one period, at the limits of speed, acceleration and torque rate.
ANGLE_STEP_RAD = 5.0 * PERIOD_S
SPEED_STEP_RAD_S = 100.0 * PERIOD_S
TORQUE_STEP_NM = 80.0 * PERIOD_S
TINY = 1e-9


def compute_bumpless_targets(modes: list[JointMode], measured: MeasuredState) -> list[float]:
    """Return the target of each joint with which its torque does not jump when it enters a mode."""
    states = zip(measured.angle_rad, measured.velocity_rad_s, measured.torque_nm, strict=True)
    return [
        compute_bumpless_target(joint, mode, *state)
        for joint, mode, state in zip(ROBOT.joints, modes, states, strict=True)
    ]


def make_measured_state(
    angle_rad: float = 0.0, velocity_rad_s: float = 0.0, torque_nm: float = 0.0
) -> MeasuredState:
    """Return a measured state that is the same for every joint."""
    return MeasuredState(
        np.full(JOINT_COUNT, angle_rad),
        np.full(JOINT_COUNT, velocity_rad_s),
        np.full(JOINT_COUNT, torque_nm),
    )


def make_last_setpoints(mode: JointMode, target: float = 0.0) -> AppliedSetpoints:
    """Return setpoints of the last period that are the same for every joint, with the full torque limit."""
    return AppliedSetpoints(
        np.full(JOINT_COUNT, int(mode)), np.full(JOINT_COUNT, target), LIMITS.torque_nm
    )


def limit_setpoints(
    command: JointCommand,
    measured: MeasuredState,
    last: AppliedSetpoints,
    torque_fraction: Any = FULL_TORQUE,
) -> AppliedSetpoints:
    """Return the setpoints that the limiter applies for a command.

    Args:
        command: The requested setpoints.
        measured: The measured state of the joints.
        last: The setpoints that were applied in the last period.
        torque_fraction: (joints,) fraction of its full torque that each drive may use.
    """
    return limit_command(
        command, measured=measured, last=last, limits=LIMITS, torque_fraction=torque_fraction
    )


def find_limit_names(
    command: JointCommand,
    applied: AppliedSetpoints,
    measured: MeasuredState,
    torque_fraction: Any = FULL_TORQUE,
) -> dict[int, str]:
    """Return the name of the limit that changed the command of a joint, by the index of the joint."""
    return find_active_limits(
        command, applied, measured=measured, limits=LIMITS, torque_fraction=torque_fraction
    )


def limit_in_equal_states(
    command: JointCommand,
    angle: float = 0.0,
    velocity: float = 0.0,
    torque: float = 0.0,
    mode: JointMode = JointMode.PASSIVE,
) -> AppliedSetpoints:
    """Return the setpoints that the limiter applies if all joints are in the same state.

    Args:
        command: The requested setpoints.
        angle: Measured angle of every joint in rad.
        velocity: Measured velocity of every joint in rad/s.
        torque: Measured torque of every joint in N·m.
        mode: Last mode of every joint. Its last target was 1.
    """
    measured = make_measured_state(angle, velocity, torque)
    return limit_setpoints(command, measured, make_last_setpoints(mode, 1.0))
