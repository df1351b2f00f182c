"""Arguments of `snakesim ros2`. Importable without the extra that it needs, and without Zenoh."""

import argparse
import re
from typing import Any

from snakesim_hal.base.errors import ConfigError, short
from snakesim_hal.network.endpoint import check_endpoint
from snakesim_hal.programs.arguments import add_network, number

ROS_ROUTER = "tcp/127.0.0.1:7447"  # where `ros2 run rmw_zenoh_cpp rmw_zenohd` listens
LAST_DOMAIN = 232  # as with DDS
MAX_HZ = 200.0
TASK = "watch"  # under which `snakesim --help` lists it


def add_commands(commands: Any) -> None:
    """Add it to the parser of `snakesim`."""
    made: argparse.ArgumentParser = commands.add_parser(
        "ros2",
        help="be a ROS 2 node for a robot, through the router of rmw_zenoh; needs no ROS",
        epilog="Publishes joint states, transforms, markers, images, IMUs, scans, the robot's URDF, diagnostics and "
        "/clock. ROS may stop the robot, and nothing else without --cmd-vel, --joint-commands or --operate.",
    )
    made.add_argument("--domain", type=number(0, LAST_DOMAIN), default=0, metavar="N", help="ROS_DOMAIN_ID (0)")
    made.add_argument(
        "--ros-router", default=ROS_ROUTER, metavar="ENDPOINT", help=f"router of the ROS nodes ({ROS_ROUTER})"
    )
    made.add_argument("--ros-namespace", metavar="NAME", help="of topics and frames, for several robots in one graph")
    most = (("--hz", 50.0, "messages a second of a topic"), ("--image-hz", 5.0, "images a second of a camera"))
    for flag, default, what in most:
        about = f"most {what} ({default:g})"
        made.add_argument(flag, type=number(0.1, MAX_HZ, "Hz"), default=default, metavar="HZ", help=about)
    made.add_argument("--cmd-vel", action="store_true", help="let ROS ask for speed and direction, on cmd_vel")
    made.add_argument(
        "--joint-commands",
        action="store_true",
        help="be the robot's controller: ROS commands joints, on joint_commands",
    )
    made.add_argument("--operate", action="store_true", help="let ROS arm, disarm, clear and set parameters")
    made.add_argument(
        "--stamps",
        choices=["robot", "wall"],
        help="robot: robot time, with /clock; wall: wall-clock time (default: robot if nothing real moves, else wall)",
    )
    add_network(made)
    made.set_defaults(act=_ros2)


def _ros2(arguments: argparse.Namespace) -> int:
    check(arguments)
    from snakesim_operator.base.robot_selection import selection_of
    from snakesim_operator.features.ros2.join import join

    return join(arguments, selection_of(arguments))


def check(arguments: argparse.Namespace) -> None:
    """Raises ConfigError for what cannot be meant."""
    from snakesim_operator.base import extras

    extras.check("ros2", "`snakesim ros2`")
    check_endpoint(arguments.ros_router, "--ros-router")
    name = arguments.ros_namespace
    if name is not None and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
        raise ConfigError(
            f"--ros-namespace {short(name)!r}: give a name such as planar13 or lab/planar13: letters, digits, _"
        )
