"""A robot of three joints, and its limits as the gate has them."""

import numpy as np

from snakesim_hal.safety.gate import Applied, JointLimits, Measured, bumpless_target, limit
from snakesim_hal.safety.lease import Lease
from snakesim_hal.wire.messages import JointCommand, Mode
from tests.unit.hal.rig import description

ROBOT = description()
LIMITS = JointLimits.of(ROBOT)
JOINTS = len(ROBOT.joints)
COOL = np.ones(JOINTS)
LEASE = Lease("control", 1, 100, 1000)
ANGLE_STEP = 5.0 * 0.01  # rad a period
SPEED_STEP = 100.0 * 0.01  # rad/s a period
TORQUE_STEP = 80.0 * 0.01  # N·m a period
TINY = 1e-9


def bumpless(modes: list[Mode], measured: Measured) -> list[float]:
    now = zip(measured.angle_rad, measured.velocity_rad_s, measured.torque_nm, strict=True)
    return [bumpless_target(joint, mode, *state) for joint, mode, state in zip(ROBOT.joints, modes, now, strict=True)]


def applied_for(
    asked: JointCommand, angle: float = 0.0, velocity: float = 0.0, torque: float = 0.0, before: Mode = Mode.PASSIVE
) -> Applied:
    """What is applied when every joint is in the same situation; the target before was 1."""
    measured = Measured(np.full(JOINTS, angle), np.full(JOINTS, velocity), np.full(JOINTS, torque))
    last = Applied(np.full(JOINTS, int(before)), np.ones(JOINTS), LIMITS.torque_nm)
    return limit(asked, measured=measured, last=last, limits=LIMITS, share=COOL)
