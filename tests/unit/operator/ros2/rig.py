"""Shipped robots, as their hosts describe them."""

import msgspec

from snakesim_hal.model.files import read_part
from snakesim_hal.model.robot import RobotFile, describe
from snakesim_hal.wire.messages import Description, JointState


def of_robot(name: str) -> Description:
    """Description of a shipped robot."""
    file = msgspec.convert(read_part(name, "robots").values, RobotFile)
    return describe(file, backend="sim", period_ns=10_000_000, lease_ns=50_000_000, config_hash="0" * 16)


def resting(robot: Description, angles_rad: list[float]) -> JointState:
    """Joints at these angles, all valid."""
    count = len(robot.joints)
    zeros = [0.0] * count
    return JointState(
        tick=0,
        stamp_ns=0,
        angle_rad=angles_rad,
        velocity_rad_s=zeros,
        torque_nm=zeros,
        valid=[True] * count,
        age_ns=[0] * count,
    )
