"""The bridge's two sessions: one on the robot's network, one on that of the ROS nodes."""

import argparse
import contextlib
import time
from dataclasses import replace

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.terminal import say
from snakesim_hal.network.foreign_network import open_foreign_network
from snakesim_hal.network.session import Link, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_hal.wire.messages import Description
from snakesim_operator.base.targets import RobotSelection, only_robot
from snakesim_operator.features.ros2.bridge import Bridge, Options, is_consistent
from snakesim_operator.features.ros2.driving import Driving
from snakesim_operator.features.ros2.graph import Node, NodeName, Topic
from snakesim_operator.features.ros2.messages import JOINT_STATE
from snakesim_operator.features.ros2.operating import operating_servers
from snakesim_operator.features.ros2.parameters import parameter_servers

MAX_IN_BYTES = 65536  # of a message from ROS; a Twist has 52
KEPT_COMMANDS = 64  # messages that name a joint each, between two ticks
STARTING_S = 60.0  # a robot may take so long to start


def join(arguments: argparse.Namespace, where: RobotSelection) -> int:
    """Run the bridge until Ctrl-C. Raises ConfigError, NotConnectedError."""
    link = _started(where)
    if link.endpoint == arguments.ros_router:
        raise ConfigError(
            f"--ros-router {arguments.ros_router}: {link.namespace} itself is on this endpoint, and ROS nodes are not "
            f"let into its network. On one computer give the robot another port: --endpoint tcp/127.0.0.1:7448 behind "
            "`snakesim run`; this command finds it there"
        )
    with open_session(replace(link, max_bytes=MAX_IMAGE_BYTES)) as session:
        robot = session.latest(keys.DESCRIPTION, Description, STARTING_S, is_consistent)
        if robot is None:
            raise NotConnectedError(f"{link.namespace} does not describe itself within {STARTING_S:g} s")
        wall_time = not robot.emulated if arguments.stamps is None else arguments.stamps == "wall"
        options = Options(
            namespace=arguments.ros_namespace or "",
            hz=arguments.hz,
            images_hz=arguments.image_hz,
            cmd_vel=arguments.cmd_vel,
            wall_time=wall_time,
        )
        with contextlib.ExitStack() as opened:
            try:
                network = opened.enter_context(open_foreign_network(arguments.ros_router, max_bytes=MAX_IN_BYTES))
            except NotConnectedError:
                raise NotConnectedError(
                    f"no router of ROS nodes on {arguments.ros_router}; start it by "
                    "`ros2 run rmw_zenoh_cpp rmw_zenohd`, or give --ros-router"
                ) from None
            name = NodeName("snakesim", f"/{options.namespace}")
            node = Node(network, arguments.domain, name)
            made = Bridge(session, node, robot, options)
            operate: bool = arguments.operate
            servers = [
                *operating_servers(session, node, link, made.prefix, operate=operate),
                *parameter_servers(session, node, f"/{made.prefix}{name.name}", operate=operate),
            ]
            for server in servers:
                opened.callback(server.close)
            if arguments.joint_commands:
                commands = node.subscription(Topic(f"/{made.prefix}joint_commands", JOINT_STATE, depth=KEPT_COMMANDS))
                opened.callback(Driving(session, commands, say, wall_time=wall_time).close)
            say(
                f"{link.namespace} is in ROS domain {arguments.domain} through {arguments.ros_router}; stamps are "
                f"{'wall-clock' if wall_time else 'robot'} time; Ctrl-C ends it"
            )
            due_s = time.monotonic()
            while True:
                made.turn()
                for server in servers:
                    server.turn(say)
                due_s = max(due_s + 1.0 / arguments.hz, time.monotonic())
                time.sleep(max(0.0, due_s - time.monotonic()))


def _started(where: RobotSelection) -> Link:
    """The robot, also one that is starting just now."""
    until_s, told = time.monotonic() + STARTING_S, False
    while True:
        try:
            return only_robot(where, "ros2")
        except NotConnectedError as error:
            if time.monotonic() > until_s:
                raise
            if not told:
                say(f"{error}. Waiting for it up to {STARTING_S:g} s")
            told = True
            time.sleep(0.5)
