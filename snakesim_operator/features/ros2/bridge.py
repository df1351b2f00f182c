"""The bridge's loop: it reads one robot's network as a viewer does, and publishes as a ROS node.

    robot's keys -> relays (newest sample, bounded rate) -> encoders -> ROS topics
    ROS topic cmd_vel -> steering -> intents of the robot

The bridge polls: in each cycle it reads the newest sample of each key. Samples do not queue up, a slow ROS network
delays only this process, and images are read only while a ROS node subscribes to them.
"""

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.geometry.kinematics import compute_body_points_w
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire import messages as m
from snakesim_operator.features.ros2 import messages as ros
from snakesim_operator.features.ros2 import robot_in_ros
from snakesim_operator.features.ros2.frames import RobotFrames
from snakesim_operator.features.ros2.graph import RosNode, RosPublisher, RosTopic, RosType
from snakesim_operator.features.ros2.messages import RosTransform
from snakesim_operator.features.ros2.relay import NewestRelay, RosTime, TopicRelay
from snakesim_operator.features.ros2.sensor_topics import SensorTopics, StaticFrames
from snakesim_operator.features.ros2.steering import CmdVelInput
from snakesim_operator.features.ros2.urdf import make_urdf

MARKER_RATE_HZ = 5.0
STATUS_RATE_HZ = 1.0
SILENCE_TIMEOUT_S = 2.0  # without a sample: its publisher is taken to be gone


@dataclass(frozen=True)
class BridgeOptions:
    """Options of the command line."""

    namespace: str = ""  # of the ROS topics; also before frame names
    hz: float = 50.0  # cycles of the bridge; joint states, transforms and /clock come in each cycle
    images_hz: float = 5.0
    cmd_vel: bool = False  # whether ROS may steer the robot
    wall_time: bool = False  # timestamps are wall-clock time, and /clock is not published


def is_consistent(robot: m.RobotDescription) -> bool:
    """Return whether a description has a link at both ends of every joint."""
    return len(robot.links) == len(robot.joints) + 1


def _accept_any_clock(_clock: m.Clock) -> bool:
    return True


class RosBridge:
    """One robot as one ROS node."""

    def __init__(
        self, session: Session, node: RosNode, robot: m.RobotDescription, options: BridgeOptions
    ) -> None:
        """Declare the ROS topics, and publish the description of the robot.

        Args:
            session: Session on the robot's network.
            node: The ROS node.
            robot: Description of the robot.
            options: Options of the command line.
        """
        self._session = session
        self._node = node
        self._options = options
        self._cycle_number = 0
        self.prefix = ""  # before the names of topics and frames
        if options.namespace:
            self.prefix = f"{options.namespace.strip('/')}/"

        # Robot time.
        self._clock_reader = session.declare_reader(keys.CLOCK, m.Clock)
        self._clock: m.Clock | None = None
        # None: the user knows that the robot is silent.
        self._clock_arrival_s: float | None = time.monotonic()
        self._ros_time = RosTime(wall_time=options.wall_time)

        # The newest messages of the robot.
        self._description_reader = session.declare_latched_reader(
            keys.DESCRIPTION, m.RobotDescription
        )
        self._joint_state: m.JointState | None = None
        self._world: m.WorldModel | None = None
        self._world_arrival_s = 0.0
        self._unpublished_world: m.WorldModel | None = None  # its markers are not published

        # ROS topics.
        self._declare_topics()
        self._sensor_topics = SensorTopics(
            session, node, self.prefix, self._ros_time, self._static_frames
        )
        self._cmd_vel: CmdVelInput | None = None
        if options.cmd_vel:
            self._cmd_vel = self._make_cmd_vel_input()
        self._set_robot(robot)
        self._relays = self._make_relays(robot)

    def run_cycle(self) -> None:
        """Run one cycle of the bridge: forward new samples from the robot to ROS, and from ROS to the robot."""
        self._read_clock(time.monotonic())
        self._read_description()
        for relay in self._relays:
            relay.poll(self._cycle_number, self._matches_robot)
        if self._cmd_vel is not None:
            self._poll_cmd_vel(self._cmd_vel)
        markers_are_due = self._cycle_number % self._count_cycles_between(MARKER_RATE_HZ) == 0
        if self._unpublished_world is not None and markers_are_due:
            self._publish_markers(self._unpublished_world)
            self._unpublished_world = None
        self._cycle_number += 1

    # --- setup

    def _declare_topics(self) -> None:
        """Declare the publishers of the topics that every robot has. /tf, /diagnostics and /clock have no namespace."""
        self._joint_state_publisher = self._declare_publisher("joint_states", ros.JOINT_STATE)
        tf_topic = RosTopic("/tf", ros.TRANSFORMS, depth=100)
        self._transform_publisher = self._node.declare_publisher(tf_topic)
        static_topic = RosTopic("/tf_static", ros.TRANSFORMS, depth=1, latched=True)
        static_publisher = self._node.declare_publisher(static_topic)
        self._static_frames = StaticFrames(static_publisher, self._ros_time)
        self._description_publisher = self._declare_publisher(
            "robot_description", ros.STRING, depth=1, latched=True
        )
        self._contact_marker_publisher = self._declare_publisher("contacts", ros.MARKERS)
        self._obstacle_marker_publisher = self._declare_publisher("obstacles", ros.MARKERS)
        diagnostics_topic = RosTopic("/diagnostics", ros.DIAGNOSTICS)
        self._diagnostics_publisher = self._node.declare_publisher(diagnostics_topic)
        self._clock_publisher: RosPublisher | None = None
        if not self._options.wall_time:
            clock_topic = RosTopic("/clock", ros.CLOCK, depth=1, best_effort=True)
            self._clock_publisher = self._node.declare_publisher(clock_topic)

    def _declare_publisher(self, name: str, ros_type: RosType, **quality: Any) -> RosPublisher:
        return self._node.declare_publisher(RosTopic(f"/{self.prefix}{name}", ros_type, **quality))

    def _make_cmd_vel_input(self) -> CmdVelInput:
        twists = self._node.declare_subscription(
            RosTopic(f"/{self.prefix}cmd_vel", ros.TWIST, depth=1)
        )
        return CmdVelInput(twists, self._session, print_line)

    def _set_robot(self, robot: m.RobotDescription) -> None:
        """Use this description of the robot from now on, and publish it in ROS."""
        self._robot = robot
        self._frames = RobotFrames(robot, self.prefix)
        self._joint_names = [joint.name for joint in robot.joints]
        self._sensor_topics.set_robot(robot, self._frames)
        urdf = make_urdf(robot, self.prefix)
        self._description_publisher.publish(ros.encode_string(urdf))
        self._static_frames.reset(self._frames)

    def _make_relays(self, robot: m.RobotDescription) -> list[TopicRelay[Any]]:
        """Return the relays of all keys that this robot has."""
        session = self._session
        every_cycle = 1
        status_cycles = self._count_cycles_between(STATUS_RATE_HZ)
        image_cycles = self._count_cycles_between(self._options.images_hz)
        relays: list[TopicRelay[Any]] = [
            NewestRelay(session, keys.JOINTS, m.JointState, every_cycle, self._forward_joints),
            NewestRelay(session, keys.WORLD, m.WorldModel, every_cycle, self._forward_world),
            NewestRelay(session, keys.STATUS, m.RobotStatus, status_cycles, self._forward_status),
        ]
        has_pose_sensor = any(sensor.key == keys.POSE for sensor in robot.sensors)
        if has_pose_sensor:
            relays.append(NewestRelay(session, keys.POSE, m.Pose, every_cycle, self._forward_pose))
        relays += self._sensor_topics.make_relays(image_cycles)
        return relays

    def _count_cycles_between(self, hz: float) -> int:
        """Return the number of bridge cycles between two messages that come at most at this rate."""
        return max(1, math.ceil(self._options.hz / hz))

    def _matches_robot(self, message: m.Message) -> bool:
        return find_mismatch(message, self._robot) is None

    # --- from the robot to ROS

    def _read_clock(self, now_s: float) -> None:
        """Read the robot's time, and report a restart of its host, its silence and its return to the user, once."""
        clock = self._clock_reader.pop_newest(_accept_any_clock)
        if clock is not None:
            self._update_clock(clock, now_s)
        elif (
            self._clock_arrival_s is not None and now_s - self._clock_arrival_s > SILENCE_TIMEOUT_S
        ):
            print_line(f"no clock from the robot for {SILENCE_TIMEOUT_S:g} s; waiting for it")
            self._clock_arrival_s = None

    def _update_clock(self, clock: m.Clock, now_s: float) -> None:
        if self._clock is not None and clock.tick < self._clock.tick:
            self._ros_time.reset()
            print_line("the robot's host has restarted: its time starts over")
        self._ros_time.add_clock(clock.timestamp_ns)
        self._clock = clock
        if self._clock_publisher is not None:
            self._clock_publisher.publish(ros.encode_clock(clock.timestamp_ns))
        if self._clock_arrival_s is None:
            print_line("the robot is back")
        self._clock_arrival_s = now_s

    def _read_description(self) -> None:
        robot = self._description_reader.pop_newest(is_consistent)
        if robot is not None and robot != self._robot:
            self._set_robot(robot)

    def _forward_joints(self, joints: m.JointState) -> None:
        self._joint_state = joints
        timestamp_ns = self._ros_time.convert(joints.timestamp_ns)
        message = robot_in_ros.encode_joint_state(timestamp_ns, self._joint_names, joints)
        self._joint_state_publisher.publish(message)
        self._publish_transforms(joints.timestamp_ns, self._frames.make_joint_transforms(joints))

    def _forward_world(self, world: m.WorldModel) -> None:
        self._world = world
        self._unpublished_world = world
        self._world_arrival_s = time.monotonic()
        self._publish_transforms(
            _find_pose_time_ns(world), [self._frames.make_base_transform(world)]
        )

    def _forward_pose(self, pose: m.Pose) -> None:
        """Publish the measured pose of the base, while no world model gives an estimate of it."""
        if self._is_world_model_silent():
            self._publish_transforms(pose.timestamp_ns, [self._frames.make_base_transform(pose)])

    def _publish_transforms(self, robot_ns: int, transforms: list[RosTransform]) -> None:
        timestamp_ns = self._ros_time.convert(robot_ns)
        self._transform_publisher.publish(ros.encode_transforms(timestamp_ns, transforms))

    def _forward_status(self, status: m.RobotStatus) -> None:
        timestamp_ns = self._ros_time.convert(status.timestamp_ns)
        self._diagnostics_publisher.publish(robot_in_ros.encode_diagnostics(timestamp_ns, status))

    def _publish_markers(self, world: m.WorldModel) -> None:
        """Publish the contacts and obstacles of a world model."""
        frame = self._frames.odom
        contacts_ns = world.timestamp_ns
        if world.contacts_timestamp_ns is not None:
            contacts_ns = world.contacts_timestamp_ns
        contacts = robot_in_ros.make_contact_markers(world.contacts)
        timestamp_ns = self._ros_time.convert(contacts_ns)
        self._contact_marker_publisher.publish(ros.encode_markers(timestamp_ns, frame, contacts))
        obstacles = robot_in_ros.make_obstacle_markers(world)
        timestamp_ns = self._ros_time.convert(world.timestamp_ns)
        self._obstacle_marker_publisher.publish(ros.encode_markers(timestamp_ns, frame, obstacles))

    def _is_world_model_silent(self) -> bool:
        return time.monotonic() - self._world_arrival_s > SILENCE_TIMEOUT_S

    # --- from ROS to the robot

    def _poll_cmd_vel(self, cmd_vel: CmdVelInput) -> None:
        robot_ns: int | None = None
        if self._clock is not None and self._clock_arrival_s is not None:
            robot_ns = self._clock.timestamp_ns
        cmd_vel.publish_newest_intent(robot_ns, self._find_heading)

    def _find_heading(self) -> float | None:
        """Return the direction from the tail to the head joint in the world in rad, or None if it is unknown."""
        world = self._world
        joints = self._joint_state
        if world is None or joints is None or self._is_world_model_silent():
            return None
        body_points_w = compute_body_points_w(
            self._robot, world.base_position_w, world.base_orientation_wxyz, joints.angle_rad
        )
        # From the tail end to the head joint: the last point is the head end, which swings with the head.
        tail_to_head = body_points_w[-2] - body_points_w[0]
        return float(np.arctan2(tail_to_head[1], tail_to_head[0]))


def _find_pose_time_ns(world: m.WorldModel) -> int:
    """Return the robot time in ns at which the base pose of a world model holds.

    An estimated pose holds at the time of the world model, a measured one at the time of its measurement.
    """
    is_estimated = world.base_position_sd_m is not None
    if is_estimated or not world.pose_timestamp_ns:
        return world.timestamp_ns
    return world.pose_timestamp_ns
