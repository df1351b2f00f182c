"""A robot of three joints, and its limits as the limiter has them."""

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
JOINTS = len(ROBOT.joints)
COOL = np.ones(JOINTS)
LEASE = CommandLease("control", 1, 100, 1000)
ANGLE_STEP = 5.0 * 0.01  # rad a period
SPEED_STEP = 100.0 * 0.01  # rad/s a period
TORQUE_STEP = 80.0 * 0.01  # N·m a period
TINY = 1e-9


def bumpless(modes: list[JointMode], measured: MeasuredState) -> list[float]:
    now = zip(measured.angle_rad, measured.velocity_rad_s, measured.torque_nm, strict=True)
    return [
        compute_bumpless_target(joint, mode, *state)
        for joint, mode, state in zip(ROBOT.joints, modes, now, strict=True)
    ]


def every(angle: float = 0.0, velocity: float = 0.0, torque: float = 0.0) -> MeasuredState:
    """Every joint is measured like this."""
    return MeasuredState(np.full(JOINTS, angle), np.full(JOINTS, velocity), np.full(JOINTS, torque))


def before(mode: JointMode, target: float = 0.0) -> AppliedSetpoints:
    """What was applied last: the same to every joint, and the whole torque."""
    return AppliedSetpoints(np.full(JOINTS, int(mode)), np.full(JOINTS, target), LIMITS.torque_nm)


def limited(
    asked: JointCommand,
    measured: MeasuredState,
    last: AppliedSetpoints,
    torque_fraction: Any = COOL,
) -> AppliedSetpoints:
    return limit_command(
        asked, measured=measured, last=last, limits=LIMITS, torque_fraction=torque_fraction
    )


def words(
    asked: JointCommand,
    applied: AppliedSetpoints,
    measured: MeasuredState,
    torque_fraction: Any = COOL,
) -> dict[int, str]:
    return find_active_limits(
        asked, applied, measured=measured, limits=LIMITS, torque_fraction=torque_fraction
    )


def applied_for(
    asked: JointCommand,
    angle: float = 0.0,
    velocity: float = 0.0,
    torque: float = 0.0,
    mode: JointMode = JointMode.PASSIVE,
) -> AppliedSetpoints:
    """What is applied when every joint is in the same situation; the mode before was this, and the target 1."""
    return limited(asked, every(angle, velocity, torque), before(mode, 1.0))
