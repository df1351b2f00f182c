"""The command `snakesim start ros2`. It can be imported without the extra that the bridge needs, and without Zenoh."""

import argparse
import re

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.endpoint import check_endpoint
from snakesim_hal.programs.arguments import (
    add_network_arguments,
    add_output_argument,
    make_number_parser,
)
from snakesim_hal.programs.commands import Command, Commands
from snakesim_operator.playback.arguments import add_recording_argument

DEFAULT_ROS_ROUTER = "tcp/127.0.0.1:7447"  # where `ros2 run rmw_zenoh_cpp rmw_zenohd` listens
MAX_DOMAIN_ID = 232  # as with DDS
MIN_HZ = 0.1
MAX_HZ = 200.0
DEFAULT_HZ = 50.0
DEFAULT_IMAGE_HZ = 5.0
ROS_NAMESPACE = r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*"


def _add_bridge_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim start ros2`, which bridges a robot to ROS 2."""
    parser.add_argument(
        "--domain",
        type=make_number_parser(0, MAX_DOMAIN_ID),
        default=0,
        metavar="N",
        help="ROS_DOMAIN_ID (default: 0)",
    )
    parser.add_argument(
        "--ros-router",
        default=DEFAULT_ROS_ROUTER,
        metavar="ENDPOINT",
        help=f"router of the ROS nodes (default: {DEFAULT_ROS_ROUTER})",
    )
    parser.add_argument(
        "--ros-namespace",
        metavar="NAME",
        help="of topics and frames, for several robots in one graph",
    )
    _add_rate_option(parser, "--hz", DEFAULT_HZ, "messages a second of a topic")
    _add_rate_option(parser, "--image-hz", DEFAULT_IMAGE_HZ, "images a second of a camera")
    parser.add_argument(
        "--cmd-vel", action="store_true", help="let ROS ask for speed and direction, on cmd_vel"
    )
    parser.add_argument(
        "--joint-commands",
        action="store_true",
        help="be the robot's controller: ROS commands joints, on joint_commands",
    )
    parser.add_argument(
        "--operate", action="store_true", help="let ROS arm, disarm, reset and set parameters"
    )
    parser.add_argument(
        "--stamps",
        choices=["robot", "wall"],
        help="robot: robot time with /clock, or wall: wall-clock time (default: robot if nothing real moves, "
        "else wall)",
    )
    add_network_arguments(parser)


def _add_rate_option(
    parser: argparse.ArgumentParser, option: str, default_hz: float, subject: str
) -> None:
    """Add an option for a maximum rate in Hz. `subject` is what is counted, for the help text."""
    parser.add_argument(
        option,
        type=make_number_parser(MIN_HZ, MAX_HZ, "Hz"),
        default=default_hz,
        metavar="HZ",
        help=f"maximum {subject} (default: {default_hz:g})",
    )


def _run_bridge_command(arguments: argparse.Namespace) -> int:
    validate_arguments(arguments)
    # Imported here, because these modules need the extra `ros2`.
    from snakesim_operator.base.robot_selection import select_robots
    from snakesim_operator.features.ros2.join import run_bridge

    return run_bridge(arguments, select_robots(arguments))


def validate_arguments(arguments: argparse.Namespace) -> None:
    """Check the arguments and that the extra is installed. Raises ConfigError."""
    from snakesim_operator.base import extras

    extras.require_extra("ros2", "`snakesim start ros2`")
    check_endpoint(arguments.ros_router, "--ros-router")
    namespace = arguments.ros_namespace
    if namespace is not None and not re.fullmatch(ROS_NAMESPACE, namespace, re.ASCII):
        raise ConfigError(
            f"--ros-namespace {shorten(namespace)!r}: give a name such as planar13 or lab/planar13: letters, digits, _",
            code="network/invalid-address",
        )


def _add_rosbag_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim recording rosbag`."""
    add_recording_argument(parser)
    add_output_argument(parser, "folder of the bag (default: beside the recording)")
    parser.add_argument(
        "--stamps",
        choices=["robot", "wall"],
        default="robot",
        help="robot: robot time, with /clock; wall: the wall clock of the computer that recorded (default: robot)",
    )


def _run_rosbag_command(arguments: argparse.Namespace) -> int:
    """Run `snakesim recording rosbag`, and return its exit code."""
    from snakesim_operator.base import extras

    extras.require_extra("record", "`snakesim recording rosbag`")
    extras.require_extra("ros2", "`snakesim recording rosbag`")
    from snakesim_operator.features.ros2.bag import convert_recording_to_rosbag

    wall_time = arguments.stamps == "wall"
    return convert_recording_to_rosbag(
        arguments.recording, arguments.out, print_line, wall_time=wall_time
    )


COMMANDS: Commands = (
    Command(
        name="recording rosbag",
        help="Write a recording as a ROS 2 bag, with contact forces as WrenchStamped; needs no ROS.",
        add=_add_rosbag_arguments,
        run=_run_rosbag_command,
        details="Writes joint states, transforms, contact forces, IMUs, the robot's URDF, diagnostics and /clock, with "
        "the topics of the bridge. Exit code 0: written. 2: wrong input. 3: written, but something is missing in the "
        "recording.",
        examples=(
            "recording rosbag runs/demo --out demo-bag",
            "recording rosbag test.mcap --stamps wall",
        ),
    ),
    Command(
        name="start ros2",
        help="Start a ROS 2 node for a robot, through the router of rmw_zenoh. Needs no ROS.",
        add=_add_bridge_arguments,
        run=_run_bridge_command,
        details="Publishes joint states, transforms, markers, images, IMUs, scans, the robot's URDF, diagnostics and "
        "/clock. ROS may stop the robot, and nothing else without --cmd-vel, --joint-commands or --operate.",
        examples=(
            "start ros2 --endpoint tcp/127.0.0.1:7448",
            "start ros2 --domain 3 --cmd-vel --operate",
        ),
    ),
)
