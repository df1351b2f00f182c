"""Shipped robots, as their hosts describe them."""

import msgspec

from snakesim_hal.model.files import read_part
from snakesim_hal.model.robot import RobotFile, describe
from snakesim_hal.wire.messages import Description


def of_robot(name: str) -> Description:
    """Description of a shipped robot."""
    file = msgspec.convert(read_part(name, "robots").values, RobotFile)
    return describe(file, backend="sim", period_ns=10_000_000, lease_ns=50_000_000, config_hash="0" * 16)
