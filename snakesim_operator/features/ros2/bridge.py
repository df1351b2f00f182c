"""The bridge's loop: a viewer of one robot on one side, a ROS node on the other.

It polls: the newest sample of each key, at most so often a second. Nothing queues up, a slow ROS side delays only
this process, and images are asked for only while somebody in ROS looks at them.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from snakesim_hal.base.terminal import say
from snakesim_hal.model.kinematics import nodes_w
from snakesim_hal.network.robot_mismatch import mismatch
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire import messages as m
from snakesim_hal.wire.own_sample import message_of, own_kinds
from snakesim_operator.features.ros2 import messages as ros
from snakesim_operator.features.ros2 import robot_in_ros
from snakesim_operator.features.ros2.frames import Frames, ros_name
from snakesim_operator.features.ros2.graph import Node, RosPublisher, RosType, Topic
from snakesim_operator.features.ros2.message_age import SenderClocks
from snakesim_operator.features.ros2.messages import Transform
from snakesim_operator.features.ros2.relay import Relay, RosTime
from snakesim_operator.features.ros2.steering import Steering
from snakesim_operator.features.ros2.urdf import urdf_of

MARKERS_HZ, STATUS_HZ = 5.0, 1.0
SILENT_S = 2.0


@dataclass(frozen=True)
class Options:
    """What the command line says. wall_time: stamps are wall-clock time, and /clock is not published."""

    namespace: str = ""  # of the ROS topics; also before frame names
    hz: float = 50.0  # joint states, transforms, /clock
    images_hz: float = 5.0
    cmd_vel: bool = False
    wall_time: bool = False


def is_consistent(robot: m.Description) -> bool:
    """Whether there is a link at both ends of every joint."""
    return len(robot.links) == len(robot.joints) + 1


class Bridge:
    """One robot as one ROS node."""

    def __init__(self, session: Session, node: Node, robot: m.Description, options: Options) -> None:
        self._session, self._node, self._options = session, node, options
        self.prefix = f"{options.namespace.strip('/')}/" if options.namespace else ""
        self._ros_time = RosTime(wall_time=options.wall_time)
        self._clocks = session.reader(keys.CLOCK, m.Clock)
        self._descriptions = session.latched_reader(keys.DESCRIPTION, m.Description)
        self._clock: m.Clock | None = None
        self._heard_s: float | None = time.monotonic()  # when a clock came last; None: said to be silent
        self._joints: m.JointState | None = None
        self._world: m.World | None = None  # not drawn yet
        self._placed: m.World | None = None  # the newest
        self._world_s = 0.0  # when it came
        self._turns = 0
        self._sensors: dict[str, list[Transform]] = {}
        self._imus: dict[int, RosPublisher] = {}  # by link, from its first sample on
        self._publish_topics()
        self._meet(robot)
        self._relays = self._make_relays(robot)

    def _publish_topics(self) -> None:
        self._joint_states = self._publisher("joint_states", ros.JOINT_STATE)
        self._tf = self._node.publisher(Topic("/tf", ros.TRANSFORMS, depth=100))
        self._tf_static = self._node.publisher(Topic("/tf_static", ros.TRANSFORMS, depth=1, latched=True))
        self._described = self._publisher("robot_description", ros.STRING, depth=1, latched=True)
        self._contacts = self._publisher("contacts", ros.MARKERS)
        self._obstacles = self._publisher("obstacles", ros.MARKERS)
        self._diagnostics = self._node.publisher(Topic("/diagnostics", ros.DIAGNOSTICS))
        self._ros_clock = None
        if not self._options.wall_time:
            self._ros_clock = self._node.publisher(Topic("/clock", ros.CLOCK, depth=1, best_effort=True))
        if self._options.cmd_vel:
            self._steering, self._senders = Steering(), SenderClocks()
            self._said = ""  # why a message on cmd_vel was dropped
            self._cmd_vel = self._node.subscription(Topic(f"/{self.prefix}cmd_vel", ros.TWIST, depth=1))
            self._intents = self._session.publisher(keys.INTENT, m.Intent)

    def _publisher(self, name: str, kind: RosType, **more: Any) -> RosPublisher:
        return self._node.publisher(Topic(f"/{self.prefix}{name}", kind, **more))

    def _meet(self, robot: m.Description) -> None:
        """Describe the robot to ROS."""
        self._robot, self._frames = robot, Frames(robot, self.prefix)
        self._names = [joint.name for joint in robot.joints]
        self._sensors.clear()
        self._described.put(ros.string(urdf_of(robot, self.prefix)))
        self._put_static()

    def _put_static(self) -> None:
        fixed = [*self._frames.fixed, *(one for some in self._sensors.values() for one in some)]
        now_ns = self._ros_time.of(0 if self._clock is None else self._clock.timestamp_ns)
        self._tf_static.put(ros.transforms(now_ns, fixed))

    def _make_relays(self, robot: m.Description) -> list[Relay[Any]]:
        images = self._every(self._options.images_hz)
        made: list[Relay[Any]] = [
            Relay(self._session, keys.JOINTS, m.JointState, 1, self._on_joints),
            Relay(self._session, keys.WORLD, m.World, 1, self._on_world),
            Relay(self._session, keys.STATUS, m.Status, self._every(STATUS_HZ), self._on_status),
        ]
        listed = {sensor.key for sensor in robot.sensors}
        if keys.IMU in listed:
            made.append(Relay(self._session, keys.IMU, m.Imu, 1, self._on_imu, each=True))
        if keys.POSE in listed:
            made.append(Relay(self._session, keys.POSE, m.Pose, 1, self._on_pose))
        for key in sorted(listed):
            _, _, name = key.rpartition("/")
            if key == keys.depth(name):
                translated = (robot_in_ros.depth_image, robot_in_ros.compressed_depth)
                made.append(self._camera(key, name, "depth", m.DepthImage, translated, images))
            elif key == keys.color(name):
                translated = (robot_in_ros.color_image, robot_in_ros.compressed_color)
                made.append(self._camera(key, name, "color", m.ColorImage, translated, images))
            elif key == keys.ranges(name):
                made.append(self._mounted(key, name, "scan", ros.LASER_SCAN, robot_in_ros.laser_scan))
        for key, kind in own_kinds(robot).items():
            _, _, name = key.rpartition("/")
            for field in kind.units:
                translate = partial(robot_in_ros.numbers, kind, field)
                made.append(self._mounted(key, name, field, ros.NUMBERS, translate))
        return made

    def _camera(
        self,
        key: str,
        name: str,
        kind: str,
        message: type[Any],
        translated: tuple[Callable[[int, str, Any], bytes], ...],
        every: int,
    ) -> Relay[Any]:
        """One camera's topics: images, raw and compressed as image_transport names them, and intrinsics."""
        topic = f"{ros_name(name)}/{kind}"
        plugin = "compressedDepth" if kind == "depth" else "compressed"
        images = (
            self._publisher(f"{topic}/image_raw", ros.IMAGE, depth=1, images=True),
            self._publisher(f"{topic}/image_raw/{plugin}", ros.COMPRESSED_IMAGE, depth=1, images=True),
        )
        infos = self._publisher(f"{topic}/camera_info", ros.CAMERA_INFO, depth=1)

        def pass_on(seen: m.DepthImage | m.ColorImage) -> None:
            frame, timestamp_ns = self._frames.optical(kind, name), self._ros_time.of(seen.timestamp_ns)
            self._place(key, self._frames.of_camera(kind, name, seen))
            infos.put(robot_in_ros.camera_info(timestamp_ns, frame, seen))
            for publisher, translate in zip(images, translated, strict=True):
                if publisher.heard():
                    publisher.put(translate(timestamp_ns, frame, seen))

        def wanted() -> bool:
            return infos.heard() or any(publisher.heard() for publisher in images)

        return Relay(self._session, key, message, every, pass_on, wanted)

    def _mounted(
        self, key: str, name: str, topic: str, kind: RosType, translate: Callable[[int, str, Any], bytes]
    ) -> Relay[Any]:
        """One topic of a sensor at a place on a link, whose frame is known from its first sample on."""
        publisher = self._publisher(f"{ros_name(name)}/{topic}", kind)
        message: Any = message_of(key, self._robot)

        def pass_on(seen: m.MountedSample) -> None:
            self._place(key, self._frames.of_mount(name, seen))
            publisher.put(translate(self._ros_time.of(seen.timestamp_ns), self._frames.mount(name), seen))

        return Relay(self._session, key, message, 1, pass_on, publisher.heard)

    def _place(self, key: str, frames: list[Transform]) -> None:
        """Where a sensor sits: known from its first sample on."""
        if self._sensors.get(key) != frames:
            self._sensors[key] = frames
            self._put_static()

    # --- what comes from the robot

    def _on_joints(self, joints: m.JointState) -> None:
        self._joints = joints
        timestamp_ns = self._ros_time.of(joints.timestamp_ns)
        self._joint_states.put(robot_in_ros.joint_state(timestamp_ns, self._names, joints))
        self._tf.put(ros.transforms(timestamp_ns, self._frames.of_joints(joints)))

    def _on_imu(self, seen: m.Imu) -> None:
        for entry, link in enumerate(seen.link):
            name = ros_name(self._robot.links[link].name)
            if link not in self._imus:
                self._imus[link] = self._publisher(f"{name}/imu", ros.IMU)
            self._place(f"{keys.IMU}/{link}", [self._frames.of_imu(link)])
            if self._imus[link].heard():
                timestamp_ns = self._ros_time.of(seen.timestamp_ns)
                self._imus[link].put(robot_in_ros.imu(timestamp_ns, self._frames.imu(link), seen, entry))

    def _on_world(self, world: m.World) -> None:
        self._world = self._placed = world
        self._world_s = time.monotonic()
        reckoned = world.base_position_sd_m is not None or world.pose_timestamp_ns is None
        at_ns = world.timestamp_ns if reckoned else world.pose_timestamp_ns or world.timestamp_ns
        self._tf.put(ros.transforms(self._ros_time.of(at_ns), [self._frames.of_base(world)]))

    def _on_pose(self, pose: m.Pose) -> None:
        """Where the base is, while no guidance says it."""
        if time.monotonic() - self._world_s > SILENT_S:
            self._tf.put(ros.transforms(self._ros_time.of(pose.timestamp_ns), [self._frames.of_base(pose)]))

    def _on_status(self, status: m.Status) -> None:
        self._diagnostics.put(robot_in_ros.diagnostics(self._ros_time.of(status.timestamp_ns), status))

    # --- the loop

    def turn(self) -> None:
        """Pass on what is due, both ways."""
        self._look_at_clock(time.monotonic())
        for relay in self._relays:
            relay.turn(self._turns, lambda message: mismatch(message, self._robot) is None)
        if self._options.cmd_vel:
            self._steer()
        if self._world is not None and self._turns % self._every(MARKERS_HZ) == 0:
            self._draw(self._world)
            self._world = None
        self._turns += 1

    def _every(self, hz: float) -> int:
        """Turns between messages of at most this rate."""
        return max(1, math.ceil(self._options.hz / hz))

    def _look_at_clock(self, now_s: float) -> None:
        """Robot time; a restart of the robot; silence, which is said once."""
        clock = self._clocks.newest(lambda _clock: True)
        if clock is not None:
            if self._clock is not None and clock.tick < self._clock.tick:
                self._ros_time.start_over()
                say("the robot's host has restarted: its time starts over")
            self._ros_time.heard(clock.timestamp_ns)
            self._clock = clock
            if self._ros_clock is not None:
                self._ros_clock.put(ros.clock(clock.timestamp_ns))
            if self._heard_s is None:
                say("the robot is back")
            self._heard_s = now_s
        elif self._heard_s is not None and now_s - self._heard_s > SILENT_S:
            say(f"no clock from the robot for {SILENT_S:g} s; waiting for it")
            self._heard_s = None
        described = self._descriptions.newest(is_consistent)
        if described is not None and described != self._robot:
            self._meet(described)

    def _draw(self, world: m.World) -> None:
        at_ns = world.timestamp_ns if world.contacts_timestamp_ns is None else world.contacts_timestamp_ns
        contacts = robot_in_ros.contact_markers(world.contacts)
        self._contacts.put(ros.markers(self._ros_time.of(at_ns), self._frames.odom, contacts))
        obstacles = robot_in_ros.obstacle_markers(world)
        self._obstacles.put(ros.markers(self._ros_time.of(world.timestamp_ns), self._frames.odom, obstacles))

    def _steer(self) -> None:
        """What ROS asks for; nothing while the robot is silent, because an intent needs its time."""
        twist = self._cmd_vel.newest()
        if twist is None or self._clock is None or self._heard_s is None:
            return
        age_ns = self._senders.age_ns(twist, time.time_ns(), time.monotonic_ns())
        intent = self._steering.intent(twist.payload, self._clock.timestamp_ns, self._heading_w_rad(), age_ns)
        if intent is not None:
            self._intents.put(intent)
        elif self._steering.why != self._said:
            self._said = self._steering.why
            say(f"a message on cmd_vel {self._said}; it is dropped, with all that are alike")

    def _heading_w_rad(self) -> float | None:
        """Direction from the tail to the head joint; None: not known."""
        world, joints = self._placed, self._joints
        if world is None or joints is None or time.monotonic() - self._world_s > SILENT_S:
            return None
        nodes = nodes_w(self._robot, world.base_position_w, world.base_orientation_wxyz, joints.angle_rad)
        return float(np.arctan2(*(nodes[-2] - nodes[0])[1::-1]))
