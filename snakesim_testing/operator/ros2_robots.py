"""Describes shipped robots as their HAL hosts do, and lists the type hashes of ROS 2 services."""

import msgspec

from snakesim_hal.model.files import read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile, describe_robot
from snakesim_hal.wire.messages import RobotDescription

# `ros2 service info -v` printed the hash of ListParameters. Other programs for ROS 2 contain the other hashes.
SERVICE_HASHES = {
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "rcl_interfaces/srv/ListParameters": "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    "rcl_interfaces/srv/GetParameters": "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "rcl_interfaces/srv/GetParameterTypes": "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
    "rcl_interfaces/srv/DescribeParameters": "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
    "rcl_interfaces/srv/SetParameters": "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    "rcl_interfaces/srv/SetParametersAtomically": "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
}


def describe_shipped_robot(name: str) -> RobotDescription:
    """Return the description that the HAL host of a shipped robot publishes in simulation."""
    robot_file = msgspec.convert(read_table_with_base(name, "robots").values, RobotFile)
    return describe_robot(
        robot_file, backend="sim", period_ns=10_000_000, lease_ns=50_000_000, config_hash="0" * 16
    )
