"""Runs the bridge between its two sessions: one on the robot's network, one on that of the ROS nodes."""

import argparse
import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NoReturn

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.foreign_network import ForeignNetwork, open_foreign_network
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.base.targets import RobotSelection, find_single_robot
from snakesim_operator.features.ros2.bridge import BridgeOptions, RosBridge, is_consistent
from snakesim_operator.features.ros2.driving import JointCommander
from snakesim_operator.features.ros2.graph import NodeName, RosNode, RosTopic
from snakesim_operator.features.ros2.messages import JOINT_STATE
from snakesim_operator.features.ros2.operating import make_operating_servers
from snakesim_operator.features.ros2.parameters import make_parameter_servers
from snakesim_operator.features.ros2.server import ServiceServer

NODE_NAME = "snakesim"
MAX_ROS_MESSAGE_BYTES = 65536  # a Twist has 52
MAX_JOINT_COMMANDS = 64  # between two ticks: messages that name a single joint each
START_TIMEOUT_S = 60.0  # a robot may take so long to start
RETRY_S = 0.5  # while the robot starts


def run_bridge(arguments: argparse.Namespace, selection: RobotSelection) -> int:
    """Run the bridge until Ctrl-C.

    Args:
        arguments: The command line.
        selection: The robot that it names.

    Raises:
        ConfigError: The robot itself is on the endpoint of the ROS router.
        NotConnectedError: There is no such robot, or no router of ROS nodes.
    """
    connection = _wait_for_robot(selection)
    if connection.endpoint == arguments.ros_router:
        raise ConfigError(
            f"--ros-router {arguments.ros_router}: {connection.namespace} itself is on this endpoint, and ROS nodes "
            f"are not let into its network. On one computer give the robot another port: --endpoint "
            "tcp/127.0.0.1:7448 behind `snakesim run`; this command finds it there",
            code="network/invalid-address",
        )
    with open_session(replace(connection, max_bytes=MAX_IMAGE_BYTES)) as session:
        robot = session.wait_for_latched(
            keys.DESCRIPTION, RobotDescription, START_TIMEOUT_S, is_consistent
        )
        if robot is None:
            raise NotConnectedError(
                f"{connection.namespace} does not describe itself within {START_TIMEOUT_S:g} s",
                code="network/no-robot",
            )
        options = _make_options(arguments, robot)
        with contextlib.ExitStack() as exit_stack:
            network = _connect_to_ros(arguments.ros_router, exit_stack)
            name = NodeName(NODE_NAME, f"/{options.namespace}")
            node = RosNode(network, arguments.domain, name)
            bridge = RosBridge(session, node, robot, options)
            servers = _make_servers(
                session, node, connection, bridge.prefix, operate=arguments.operate
            )
            for server in servers:
                exit_stack.callback(server.close)
            if arguments.joint_commands:
                topic = RosTopic(
                    f"/{bridge.prefix}joint_commands", JOINT_STATE, depth=MAX_JOINT_COMMANDS
                )
                messages = node.declare_subscription(topic)
                commander = JointCommander(
                    session, messages, print_line, wall_time=options.wall_time
                )
                exit_stack.callback(commander.close)
            time_name = "robot"
            if options.wall_time:
                time_name = "wall-clock"
            print_line(
                f"{connection.namespace} is in ROS domain {arguments.domain} through {arguments.ros_router}; "
                f"stamps are {time_name} time; Ctrl-C ends it"
            )
            _run_cycles(bridge, servers, arguments.hz)


def _make_options(arguments: argparse.Namespace, robot: RobotDescription) -> BridgeOptions:
    """Return the bridge's options. Without --stamps, a real robot has wall-clock time, an emulated one robot time."""
    wall_time = not robot.emulated
    if arguments.stamps is not None:
        wall_time = arguments.stamps == "wall"
    return BridgeOptions(
        namespace=arguments.ros_namespace or "",
        hz=arguments.hz,
        images_hz=arguments.image_hz,
        cmd_vel=arguments.cmd_vel,
        wall_time=wall_time,
    )


def _connect_to_ros(endpoint: str, cleanup: contextlib.ExitStack) -> ForeignNetwork:
    try:
        return cleanup.enter_context(
            open_foreign_network(endpoint, max_bytes=MAX_ROS_MESSAGE_BYTES)
        )
    except NotConnectedError:
        raise NotConnectedError(
            f"no router of ROS nodes on {endpoint}; start it by "
            "`ros2 run rmw_zenoh_cpp rmw_zenohd`, or give --ros-router",
            code="network/nothing-listens",
        ) from None


def _make_servers(
    session: Session, node: RosNode, connection: ConnectionSettings, prefix: str, *, operate: bool
) -> list[ServiceServer]:
    operating_servers = make_operating_servers(session, node, connection, prefix, operate=operate)
    parameter_servers = make_parameter_servers(
        session, node, f"/{prefix}{NODE_NAME}", operate=operate
    )
    return operating_servers + parameter_servers


def _run_cycles(bridge: RosBridge, servers: Sequence[ServiceServer], hz: float) -> NoReturn:
    """Run the bridge's cycles at this rate until Ctrl-C; cycles that were missed are not made up for."""
    due_s = time.monotonic()
    while True:
        bridge.run_cycle()
        for server in servers:
            server.start_next_request(print_line)
        due_s = max(due_s + 1.0 / hz, time.monotonic())
        time.sleep(max(0.0, due_s - time.monotonic()))


def _wait_for_robot(selection: RobotSelection) -> ConnectionSettings:
    """Return how to reach the selected robot; wait for a robot that is starting. Raises NotConnectedError."""
    deadline_s = time.monotonic() + START_TIMEOUT_S
    is_reported = False
    while True:
        try:
            return find_single_robot(selection, "start ros2")
        except NotConnectedError as error:
            if time.monotonic() > deadline_s:
                raise
            if not is_reported:
                print_line(f"{error}. Waiting for it up to {START_TIMEOUT_S:g} s")
                is_reported = True
            time.sleep(RETRY_S)
