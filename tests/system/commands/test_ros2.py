"""`snakesim start ros2` connects a robot to a ROS network: sensors, parameters, steering, and joint commands.

The ROS node of the tests is plain Zenoh with the keys of rmw_zenoh, and rosbags for the messages. It imports nothing
of the bridge.
"""

import json
import os
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh import ext, handlers  # pyright: ignore[reportMissingModuleSource]

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, LocomotionIntent, Trajectory
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.ros2_robots import SERVICE_HASHES
from snakesim_testing.runs.command import run_in_background, running_snakesim
from snakesim_testing.runs.in_process_command import run_command_for_robot

pytestmark = pytest.mark.e2e

STORE = get_typestore(Stores.ROS2_JAZZY)
SERVICE_DEFINITIONS = {  # name: definitions of request and response
    "std_srvs/srv/Trigger": (
        "uint8 structure_needs_at_least_one_member",
        "bool success\nstring message",
    ),
    "rcl_interfaces/srv/ListParameters": (
        "string[] prefixes\nuint64 depth",
        "rcl_interfaces/msg/ListParametersResult result",
    ),
    "rcl_interfaces/srv/DescribeParameters": (
        "string[] names",
        "rcl_interfaces/msg/ParameterDescriptor[] descriptors",
    ),
    "rcl_interfaces/srv/GetParameters": (
        "string[] names",
        "rcl_interfaces/msg/ParameterValue[] values",
    ),
    "rcl_interfaces/srv/SetParameters": (
        "rcl_interfaces/msg/Parameter[] parameters",
        "rcl_interfaces/msg/SetParametersResult[] results",
    ),
    "rcl_interfaces/srv/SetParametersAtomically": (
        "rcl_interfaces/msg/Parameter[] parameters",
        "rcl_interfaces/msg/SetParametersResult result",
    ),
}
for _name, _definitions in SERVICE_DEFINITIONS.items():
    for _definition, _part in zip(_definitions, ("_Request", "_Response"), strict=True):
        ((_, _fields),) = get_types_from_msg(_definition, f"{_name}{_part}").items()
        STORE.register({f"{_name}{_part}": _fields})
ROUTER_CONFIGURATION = (
    '{mode: "router", listen: {endpoints: ["%s"]}, scouting: {multicast: {enabled: false}}}'
)
JOINT_STATE = "sensor_msgs/msg/JointState"
TRIGGER = "std_srvs/srv/Trigger"
DOUBLE_TYPE = 3  # of a ROS parameter
NOT_SET_TYPE = 0
# Sequence number, timestamp, length and global id of a publisher, as rmw_zenoh attaches them to a message.
ATTACHMENT_FORMAT = "<qqB16s"
ATTACHMENT_BYTES = 33
SEQUENCE = 7
GID = bytes(range(16))
FIRST_MESSAGE_TIMEOUT_S = 30
RUN = ("clutter", "--clock-mode", "lockstep", "--duration", "600", "--stay", "--set", "rate_hz=50")


@contextmanager
def running_ros_router(folder: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run the router of a ROS network, and yield its endpoint and its process."""
    endpoint = find_free_endpoint()
    (folder / "ros.json5").write_text(ROUTER_CONFIGURATION % endpoint)
    with run_in_background(folder, "start", "router", "ros.json5") as router:
        yield endpoint, router


def open_ros_session(endpoint: str) -> zenoh.Session:
    """Open the session of a ROS node at a router."""
    settings = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": 20000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def make_attachment(timestamp_ns: int) -> bytes:
    """Return the attachment that rmw_zenoh adds to a message."""
    return struct.pack(ATTACHMENT_FORMAT, SEQUENCE, timestamp_ns, len(GID), GID)


class RosNode:
    """A ROS node that uses the keys of rmw_zenoh, and encodes messages with rosbags."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session

    def make_key(self, topic: str, kind: str) -> str:
        """Return the Zenoh key of a topic with a message type."""
        package, _, name = kind.split("/")
        return f"0/{topic}/{package}::msg::dds_::{name}_/{STORE.hash_rihs01(kind)}"

    def wait_for_message(
        self,
        topic: str,
        kind: str,
        accept: Callable[[Any], bool] = lambda _: True,
        *,
        latched: bool = False,
    ) -> Any:
        """Subscribe to a topic, and return the first message that is accepted.

        Args:
            topic: Name of the topic.
            kind: Its message type.
            accept: Returns whether a message is the awaited one.
            latched: Whether to request the last message that was published before.
        """
        key = self.make_key(topic, kind)
        ring = handlers.RingChannel(20)
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        subscriber: Any
        if latched:
            subscriber = ext.declare_advanced_subscriber(self.session, key, ring, history=history)
        else:
            subscriber = self.session.declare_subscriber(key, ring)
        deadline_s = time.monotonic() + FIRST_MESSAGE_TIMEOUT_S
        try:
            while time.monotonic() < deadline_s:
                sample = subscriber.try_recv()
                if sample is None:
                    time.sleep(0.01)
                    continue
                assert sample.attachment is not None
                assert len(sample.attachment.to_bytes()) == ATTACHMENT_BYTES
                message = STORE.deserialize_cdr(sample.payload.to_bytes(), kind)
                if accept(message):
                    return message
        finally:
            subscriber.undeclare()
        raise AssertionError(f"no awaited message on {topic} within {FIRST_MESSAGE_TIMEOUT_S} s")

    def make_message(self, kind: str, *fields: Any) -> Any:
        """Return a message of a type with its fields in order."""
        return STORE.types[kind](*fields)

    def call_service(self, name: str, kind: str, request: Any) -> Any:
        """Call a service as a client of rmw_zenoh, and return its response; None if no node has the service."""
        key = f"0/{name}/{kind.replace('/', '::').replace('::srv::', '::srv::dds_::')}_/RIHS01_{SERVICE_HASHES[kind]}"
        attachment = make_attachment(time.time_ns())
        payload = bytes(STORE.serialize_cdr(request, f"{kind}_Request"))
        replies = list(
            self.session.get(
                key,
                payload=payload,
                attachment=attachment,
                target=zenoh.QueryTarget.ALL_COMPLETE,
                timeout=20.0,
            )
        )
        if not replies:
            return None
        reply = replies[-1]
        assert reply.ok is not None
        assert reply.ok.attachment is not None
        sequence, _, length, gid = struct.unpack(ATTACHMENT_FORMAT, reply.ok.attachment.to_bytes())
        assert sequence == SEQUENCE
        assert length == len(GID)
        assert gid == GID
        return STORE.deserialize_cdr(reply.ok.payload.to_bytes(), f"{kind}_Response")

    def call_trigger(self, name: str) -> Any:
        """Call a trigger service, and return its response; None if no node has the service."""
        return self.call_service(name, TRIGGER, self.make_message(f"{TRIGGER}_Request", 0))

    def trigger(self, name: str) -> None:
        """Call a trigger service, which must succeed."""
        response = self.call_trigger(name)
        assert response is not None, f"{name}: no response"
        assert response.success, f"{name}: {response}"

    def call_parameter_service(self, name: str, kind: str, *fields: Any) -> Any:
        """Call a parameter service of the bridge, and return its response."""
        kind = f"rcl_interfaces/srv/{kind}"
        request = self.make_message(f"{kind}_Request", *fields)
        return self.call_service(f"snakesim/{name}", kind, request)

    def make_parameter(self, name: str, value: float) -> Any:
        """Return a parameter with a number as its value."""
        arrays = [np.array([], dtype=kind) for kind in (np.uint8, np.bool_, np.int64, np.float64)]
        parameter_value = self.make_message(
            "rcl_interfaces/msg/ParameterValue", DOUBLE_TYPE, False, 0, value, "", *arrays, []
        )
        return self.make_message("rcl_interfaces/msg/Parameter", name, parameter_value)

    def command_joints(self, names: list[str], **values: list[float]) -> None:
        """Publish a joint command.

        Args:
            names: The commanded joints.
            values: Their values for `position`, `velocity` or `effort`.
        """
        timestamp = self.make_message("builtin_interfaces/msg/Time", 0, 0)
        header = self.make_message("std_msgs/msg/Header", timestamp, "")
        arrays = [
            np.array(values.get(field, []), dtype=np.float64)
            for field in ("position", "velocity", "effort")
        ]
        message = self.make_message(JOINT_STATE, header, names, *arrays)
        payload = bytes(STORE.serialize_cdr(message, JOINT_STATE))
        self.session.put(self.make_key("joint_commands", JOINT_STATE), payload)

    def repeat_until_joints(
        self, act: Callable[[], None], are_there: Callable[[dict[str, float]], bool]
    ) -> dict[str, float]:
        """Repeat an action until the joint angles satisfy a condition, and return the angles in rad."""

        def act_and_check(state: Any) -> bool:
            act()
            return are_there(dict(zip(state.name, state.position, strict=True)))

        state = self.wait_for_message("joint_states", JOINT_STATE, act_and_check)
        return dict(zip(state.name, state.position, strict=True))

    def list_liveliness_tokens(self) -> list[str]:
        """Return the tokens of all nodes, publishers and services in the ROS graph."""
        replies = self.session.liveliness().get("@ros2_lv/0/**", timeout=2.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


@pytest.mark.heavy
def test_ros_node_reads_sensors_steers_and_sets_parameters(tmp_path: Path) -> None:
    with (
        running_snakesim(tmp_path / "run", *RUN) as run,
        running_ros_router(tmp_path) as (ros_endpoint, router),
    ):
        run.wait_for(" s  ")
        refused = run_command_for_robot(run, "start", "ros2", "--ros-router", run.endpoint)
        assert refused.code == 2
        assert "itself is on this endpoint" in refused.err
        refused = run_command_for_robot(
            run, "start", "ros2", "--ros-router", ros_endpoint, "--joint-commands"
        )
        assert refused.code != 0
        assert "has a controller already, which holds the lease" in refused.err
        bridge = (
            "start",
            "ros2",
            "--endpoint",
            run.endpoint,
            "--ros-router",
            ros_endpoint,
            "--cmd-vel",
            "--operate",
        )
        with open_ros_session(ros_endpoint) as session, run_in_background(tmp_path, *bridge):
            _check_sensor_topics(RosNode(session))
            _check_steering(RosNode(session), run.endpoint)
            _check_parameters(RosNode(session))
            _check_frozen_router(RosNode(session), router.pid, run.endpoint)
            with open_ros_session(ros_endpoint) as new_session:
                RosNode(new_session).wait_for_message("joint_states", JOINT_STATE)
        with open_ros_session(ros_endpoint) as session:
            wait_until(
                lambda: not RosNode(session).list_liveliness_tokens(),
                "a ROS graph without the bridge",
                10.0,
            )


@pytest.mark.slow
def test_ros_bridge_started_before_the_robot_waits_for_it(tmp_path: Path) -> None:
    endpoint = find_free_endpoint()
    run_arguments = (
        "run",
        "triplet",
        "--clock-mode",
        "lockstep",
        "--duration",
        "600",
        "--no-record",
        "--endpoint",
        endpoint,
    )
    with (
        running_ros_router(tmp_path) as (ros_endpoint, _),
        open_ros_session(ros_endpoint) as session,
        run_in_background(
            tmp_path, "start", "ros2", "--endpoint", endpoint, "--ros-router", ros_endpoint
        ) as bridge,
    ):
        assert bridge.stdout is not None
        assert "Waiting for it up to 60 s" in bridge.stdout.readline()
        with run_in_background(tmp_path, *run_arguments):
            ros = RosNode(session)
            ros.wait_for_message("joint_states", JOINT_STATE)
            assert ros.call_trigger("arm") is None
            assert ros.call_trigger("stop").success


@pytest.mark.slow
def test_ros_node_with_joint_commands_drives_joints_and_stops(tmp_path: Path) -> None:
    """A ROS node arms the robot, commands single joints, sends nothing, stops, resets and disarms."""
    run_arguments = (
        "triplet",
        "--clock-mode",
        "lockstep",
        "--duration",
        "600",
        "--stay",
        "--set",
        "services.control.external=true",
    )
    with (
        running_snakesim(tmp_path / "run", *run_arguments) as run,
        running_ros_router(tmp_path) as (ros_endpoint, _),
    ):
        bridge = (
            "start",
            "ros2",
            "--endpoint",
            run.endpoint,
            "--ros-router",
            ros_endpoint,
            "--joint-commands",
            "--operate",
        )
        with open_ros_session(ros_endpoint) as session, run_in_background(tmp_path, *bridge):
            ros = RosNode(session)
            initial = ros.wait_for_message("joint_states", JOINT_STATE)
            ros.trigger("arm")
            ros.command_joints(["joint_99"], position=[0.3])
            ros.command_joints(["joint_7", "joint_8"], position=[0.3])
            angles_rad = ros.repeat_until_joints(
                lambda: ros.command_joints(["joint_7"], position=[0.3]),
                lambda angles: angles["joint_7"] > 0.28,
            )
            # The other joints hold their angles between pegs, but their position loops are not stiff.
            changes_rad = [
                abs(angles_rad[name] - initial_rad)
                for name, initial_rad in zip(initial.name, initial.position, strict=True)
            ]
            second_largest_rad = sorted(changes_rad)[-2]
            assert second_largest_rad < 0.15
            assert angles_rad["joint_7"] == pytest.approx(0.3, abs=0.03)
            ros.repeat_until_joints(
                lambda: ros.command_joints(["joint_3"], velocity=[-0.5]),
                lambda angles: angles["joint_3"] < -0.2,
            )
            # Without commands the robot comes to rest, and remains at rest for three seconds.
            ros.wait_for_message(
                "joint_states", JOINT_STATE, lambda state: max(abs(state.velocity)) < 0.05
            )
            at_rest = ros.wait_for_message("joint_states", JOINT_STATE)
            end_s = at_rest.header.stamp.sec + 3
            later = ros.wait_for_message(
                "joint_states", JOINT_STATE, lambda state: state.header.stamp.sec >= end_s
            )
            assert max(abs(later.position - at_rest.position)) < 0.02
            ros.trigger("stop")
            refused = ros.call_trigger("arm")
            assert not refused.success
            assert "stop" in refused.message
            ros.trigger("reset")
            ros.trigger("arm")
            ros.trigger("disarm")


def _check_parameters(ros: RosNode) -> None:
    """Check what `ros2 param list`, `describe`, `set` and `get` request."""
    name = "control.speed_kp_s"
    listed = ros.call_parameter_service("list_parameters", "ListParameters", [], 0)
    assert name in listed.result.names
    (descriptor,) = ros.call_parameter_service(
        "describe_parameters", "DescribeParameters", [name]
    ).descriptors
    assert descriptor.name == name
    assert descriptor.type == DOUBLE_TYPE
    assert "[s]" in descriptor.description
    assert descriptor.floating_point_range
    parameter = ros.make_parameter(name, 0.3)
    (result,) = ros.call_parameter_service("set_parameters", "SetParameters", [parameter]).results
    assert result.successful, result.reason
    (present, unknown) = ros.call_parameter_service(
        "get_parameters", "GetParameters", [name, "control.x"]
    ).values
    assert present.type == DOUBLE_TYPE
    assert present.double_value == 0.3
    assert unknown.type == NOT_SET_TYPE
    parameter = ros.make_parameter(name, -1.0)
    refused = ros.call_parameter_service(
        "set_parameters_atomically", "SetParametersAtomically", [parameter]
    ).result
    assert not refused.successful
    assert "speed_kp_s" in refused.reason


def _check_sensor_topics(ros: RosNode) -> None:
    """Check that the bridge publishes description, sensors, images, transforms and obstacles."""
    description = ros.wait_for_message("robot_description", "std_msgs/msg/String", latched=True)
    assert description.data.count("<joint") == 14
    joints = ros.wait_for_message("joint_states", JOINT_STATE)
    assert len(joints.name) == len(joints.position) == len(joints.effort) == 13
    clock = ros.wait_for_message("clock", "rosgraph_msgs/msg/Clock").clock
    assert abs(clock.sec - joints.header.stamp.sec) <= 2
    image = ros.wait_for_message("head/depth/image_raw", "sensor_msgs/msg/Image")
    assert image.encoding == "16UC1"
    assert image.width == 160
    assert image.height == 120
    assert len(image.data) == 38400
    compressed = ros.wait_for_message(
        "head/depth/image_raw/compressedDepth", "sensor_msgs/msg/CompressedImage"
    )
    assert compressed.format == "16UC1; compressedDepth png"
    assert compressed.data[12:20].tobytes() == b"\x89PNG\r\n\x1a\n"
    imu = ros.wait_for_message("link_7/imu", "sensor_msgs/msg/Imu")
    assert imu.header.frame_id == "link_7_imu_frame"
    assert 8 < imu.linear_acceleration.z < 12
    wrench = ros.wait_for_message("link_3/contact", "geometry_msgs/msg/WrenchStamped")
    assert wrench.header.frame_id == "link_3"
    assert abs(wrench.wrench.force.y) < 1000
    info = ros.wait_for_message("head/depth/camera_info", "sensor_msgs/msg/CameraInfo")
    assert info.header.frame_id == image.header.frame_id
    assert info.k[0] == info.p[0] > 0
    _check_frames(ros, image.header.frame_id)
    markers = ros.wait_for_message(
        "obstacles", "visualization_msgs/msg/MarkerArray", lambda array: len(array.markers) > 1
    ).markers
    assert {marker.header.frame_id for marker in markers} == {"odom"}
    kinds = [token.split("/")[5] for token in ros.list_liveliness_tokens()]
    assert kinds.count("NN") == 1  # nodes
    assert kinds.count("MS") == 1  # subscribers
    assert kinds.count("MP") >= 9  # publishers


def _check_frames(ros: RosNode, camera_frame: str) -> None:
    """Check that the transforms of the bridge connect the camera with the map."""
    static = ros.wait_for_message(
        "tf_static",
        "tf2_msgs/msg/TFMessage",
        lambda message: (
            "link_7_imu_frame" in {transform.child_frame_id for transform in message.transforms}
        ),
        latched=True,
    ).transforms
    assert camera_frame in {transform.child_frame_id for transform in static}
    joints = ros.wait_for_message(
        "tf", "tf2_msgs/msg/TFMessage", lambda message: len(message.transforms) == 13
    ).transforms
    base = ros.wait_for_message(
        "tf", "tf2_msgs/msg/TFMessage", lambda message: len(message.transforms) == 1
    ).transforms
    parents = {
        transform.child_frame_id: transform.header.frame_id
        for transform in (*static, *joints, *base)
    }
    frame = camera_frame
    steps = 0
    while frame != "map":
        frame = parents[frame]
        steps += 1
    assert steps == 18  # optical frame, camera, 14 links, base, odom


def _check_steering(ros: RosNode, endpoint: str) -> None:
    """Check that navigation follows a Twist message, and that the robot stops without fresh ones."""
    linear_m_s = ros.make_message("geometry_msgs/msg/Vector3", 0.1, 0.0, 0.0)
    angular_rad_s = ros.make_message("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.2)
    twist = ros.make_message("geometry_msgs/msg/Twist", linear_m_s, angular_rad_s)
    payload = bytes(STORE.serialize_cdr(twist, "geometry_msgs/msg/Twist"))
    key = ros.make_key("cmd_vel", "geometry_msgs/msg/Twist")
    with open_session(ConnectionSettings(endpoint, "planar13_camera")) as robot:
        intents = robot.declare_reader(keys.INTENT, LocomotionIntent)
        plans = robot.declare_reader(keys.TRAJECTORY, Trajectory)

        def publish_and_check_plan() -> bool:
            ros.session.put(key, payload)
            plan = plans.pop_newest(lambda _: True)
            return plan is not None and "ros2 /cmd_vel" in plan.reason and plan.speed_m_s > 0

        wait_until(publish_and_check_plan, "navigation at the speed of /cmd_vel", 30.0)
        (*_, newest) = intents.drain()
        assert newest.speed_m_s == 0.1
        assert newest.heading_w_rad is not None
        assert abs(newest.heading_w_rad) < 3.2
        wait_until(
            lambda: (
                plans.pop_newest(lambda plan: plan.speed_m_s == 0 and "has expired" in plan.reason)
                is not None
            ),
            "a stop without /cmd_vel",
            30.0,
        )

        def becomes_intent(age_s: float) -> bool:
            """Publish a Twist of this age, and return whether it becomes an intent."""
            timestamp_ns = time.time_ns() - round(age_s * 1e9)
            ros.session.put(key, payload, attachment=make_attachment(timestamp_ns))
            time.sleep(0.1)
            return bool(intents.drain())

        wait_until(lambda: becomes_intent(0.0), "an intent from a fresh Twist", 10.0)
        time.sleep(0.5)
        intents.drain()
        assert not any(becomes_intent(14.0 - 0.1 * number) for number in range(5)), (
            "a Twist that the network delayed became an intent"
        )
        wait_until(lambda: becomes_intent(0.0), "an intent from the next Twist", 10.0)


def _check_frozen_router(ros: RosNode, router_pid: int, endpoint: str) -> None:
    """Check that the robot continues while the ROS router is suspended."""
    images = ros.session.declare_subscriber(
        ros.make_key("head/depth/image_raw", "sensor_msgs/msg/Image"), handlers.RingChannel(1)
    )
    with open_session(ConnectionSettings(endpoint, "planar13_camera")) as robot:
        clocks = robot.declare_reader(keys.CLOCK, Clock)
        os.kill(router_pid, signal.SIGSTOP)
        try:
            (first, *_) = _collect_clocks(3.0, clocks)
            assert first.lifecycle == "armed"
            (*_, last) = _collect_clocks(1.0, clocks)
            assert last.tick > first.tick
            assert last.lifecycle == "armed"
        finally:
            os.kill(router_pid, signal.SIGCONT)
    images.undeclare()


def _collect_clocks(duration_s: float, clocks: SampleReader[Clock]) -> list[Clock]:
    """Wait for a duration, and return all clock messages until then."""
    time.sleep(duration_s)
    return clocks.drain()
