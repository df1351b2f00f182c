"""`snakesim start ros2` in real processes: what a ROS node would see on its router, and what it may ask of the robot.

The ROS side is plain Zenoh with rmw_zenoh's keys, and rosbags for the messages; nothing of the bridge is imported.
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
DEFINED = {
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
for _name, _texts in DEFINED.items():
    for _text, _part in zip(_texts, ("_Request", "_Response"), strict=True):
        ((_, _fields),) = get_types_from_msg(_text, f"{_name}{_part}").items()
        STORE.register({f"{_name}{_part}": _fields})
ROUTER = '{mode: "router", listen: {endpoints: ["%s"]}, scouting: {multicast: {enabled: false}}}'
RUN = ("clutter", "--clock-mode", "lockstep", "--duration", "600", "--stay", "--set", "rate_hz=50")


@contextmanager
def ros_router(folder: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The router of a ROS network, and where it listens."""
    at = find_free_endpoint()
    (folder / "ros.json5").write_text(ROUTER % at)
    with run_in_background(folder, "start", "router", "ros.json5") as router:
        yield at, router


def session_at(endpoint: str) -> zenoh.Session:
    settings = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": 20000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


class RosSide:
    """Subscribes as rmw_zenoh does, and decodes with rosbags."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session

    def key(self, topic: str, kind: str) -> str:
        package, _, name = kind.split("/")
        return f"0/{topic}/{package}::msg::dds_::{name}_/{STORE.hash_rihs01(kind)}"

    def first(
        self,
        topic: str,
        kind: str,
        wanted: Callable[[Any], bool] = lambda _: True,
        *,
        latched: bool = False,
    ) -> Any:
        key, ring = self.key(topic, kind), handlers.RingChannel(20)
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        declared: Any = (
            ext.declare_advanced_subscriber(self.session, key, ring, history=history)
            if latched
            else self.session.declare_subscriber(key, ring)
        )
        until = time.monotonic() + 30
        try:
            while time.monotonic() < until:
                if (sample := declared.try_recv()) is None:
                    time.sleep(0.01)
                    continue
                assert sample.attachment is not None
                assert len(sample.attachment.to_bytes()) == 33
                if wanted(found := STORE.deserialize_cdr(sample.payload.to_bytes(), kind)):
                    return found
        finally:
            declared.undeclare()
        raise AssertionError(f"nothing wanted on {topic} within 30 s")

    def made(self, kind: str, *fields: Any) -> Any:
        return STORE.types[kind](*fields)

    def asked(self, name: str, kind: str, request: Any) -> Any:
        """As a client of rmw_zenoh: target and attachment are its own; None: nobody answers."""
        key = f"0/{name}/{kind.replace('/', '::').replace('::srv::', '::srv::dds_::')}_/RIHS01_{SERVICE_HASHES[kind]}"
        sent = struct.pack("<qqB16s", 7, time.time_ns(), 16, bytes(range(16)))
        payload = bytes(STORE.serialize_cdr(request, f"{kind}_Request"))
        complete = zenoh.QueryTarget.ALL_COMPLETE
        (*_, reply) = [
            None,
            *self.session.get(key, payload=payload, attachment=sent, target=complete, timeout=20.0),
        ]
        if reply is None:
            return None
        assert reply.ok is not None
        assert reply.ok.attachment is not None
        sequence, _, length, gid = struct.unpack("<qqB16s", reply.ok.attachment.to_bytes())
        assert sequence == 7
        assert length == 16
        assert gid == bytes(range(16))
        return STORE.deserialize_cdr(reply.ok.payload.to_bytes(), f"{kind}_Response")

    def trigger(self, name: str) -> None:
        answer = self.asked(
            name, "std_srvs/srv/Trigger", self.made("std_srvs/srv/Trigger_Request", 0)
        )
        assert answer is not None and answer.success, f"{name}: {answer}"

    def parameters(self, name: str, kind: str, *fields: Any) -> Any:
        kind = f"rcl_interfaces/srv/{kind}"
        return self.asked(f"snakesim/{name}", kind, self.made(f"{kind}_Request", *fields))

    def parameter(self, name: str, value: float) -> Any:
        arrays = [np.array([], dtype=kind) for kind in (np.uint8, np.bool_, np.int64, np.float64)]
        made = self.made("rcl_interfaces/msg/ParameterValue", 3, False, 0, value, "", *arrays, [])
        return self.made("rcl_interfaces/msg/Parameter", name, made)

    def command(self, names: list[str], **numbers: list[float]) -> None:
        stamp = self.made("builtin_interfaces/msg/Time", 0, 0)
        fields = [
            np.array(numbers.get(word, []), dtype=np.float64)
            for word in ("position", "velocity", "effort")
        ]
        sent = self.made(
            "sensor_msgs/msg/JointState",
            self.made("std_msgs/msg/Header", stamp, ""),
            names,
            *fields,
        )
        kind = "sensor_msgs/msg/JointState"
        self.session.put(self.key("joint_commands", kind), bytes(STORE.serialize_cdr(sent, kind)))

    def moved(
        self, act: Callable[[], None], there: Callable[[dict[str, float]], bool]
    ) -> dict[str, float]:
        """Repeat it until the joints are there; their angles in rad."""

        def wanted(state: Any) -> bool:
            act()
            return there(dict(zip(state.name, state.position, strict=True)))

        state = self.first("joint_states", "sensor_msgs/msg/JointState", wanted)
        return dict(zip(state.name, state.position, strict=True))

    def tokens(self) -> list[str]:
        replies = self.session.liveliness().get("@ros2_lv/0/**", timeout=2.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def test_a_robot_among_ros_nodes(tmp_path: Path) -> None:
    with running_snakesim(tmp_path / "run", *RUN) as run, ros_router(tmp_path) as (at, router):
        run.wait_for(" s  ")
        refused = run_command_for_robot(run, "start", "ros2", "--ros-router", run.endpoint)
        assert refused.code == 2
        assert "itself is on this endpoint" in refused.err
        refused = run_command_for_robot(
            run, "start", "ros2", "--ros-router", at, "--joint-commands"
        )
        assert refused.code != 0
        assert "has a controller already, which holds the lease" in refused.err
        bridge = (
            "start",
            "ros2",
            "--endpoint",
            run.endpoint,
            "--ros-router",
            at,
            "--cmd-vel",
            "--operate",
        )
        with session_at(at) as session, run_in_background(tmp_path, *bridge):
            _sees(RosSide(session))
            _steers(RosSide(session), run.endpoint)
            _tunes(RosSide(session))
            _outlasts_a_frozen_router(RosSide(session), router.pid, run.endpoint)
            with session_at(at) as anew:
                RosSide(anew).first("joint_states", "sensor_msgs/msg/JointState")
        with session_at(at) as session:
            wait_until(
                lambda: not RosSide(session).tokens(), "the node gone from the ROS graph", 10.0
            )


@pytest.mark.slow
def test_the_bridge_waits_for_a_robot_that_is_starting(tmp_path: Path) -> None:
    endpoint = find_free_endpoint()
    late = (
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
        ros_router(tmp_path) as (at, _),
        session_at(at) as session,
        run_in_background(
            tmp_path, "start", "ros2", "--endpoint", endpoint, "--ros-router", at
        ) as waiting,
    ):
        assert waiting.stdout is not None
        assert "Waiting for it up to 60 s" in waiting.stdout.readline()
        with run_in_background(tmp_path, *late):
            ros = RosSide(session)
            ros.first("joint_states", "sensor_msgs/msg/JointState")
            assert (
                ros.asked(
                    "arm", "std_srvs/srv/Trigger", ros.made("std_srvs/srv/Trigger_Request", 0)
                )
                is None
            )
            assert ros.asked(
                "stop", "std_srvs/srv/Trigger", ros.made("std_srvs/srv/Trigger_Request", 0)
            ).success


@pytest.mark.slow
def test_ros_drives_joints_under_the_lease(tmp_path: Path) -> None:
    """Arm, command single joints, fall silent, stop, reset, disarm: all of it as a node of rmw_zenoh would."""
    alone = (
        "triplet",
        "--clock-mode",
        "lockstep",
        "--duration",
        "600",
        "--stay",
        "--set",
        "services.control.external=true",
    )
    with running_snakesim(tmp_path / "run", *alone) as run, ros_router(tmp_path) as (at, _):
        bridge = (
            "start",
            "ros2",
            "--endpoint",
            run.endpoint,
            "--ros-router",
            at,
            "--joint-commands",
            "--operate",
        )
        with session_at(at) as session, run_in_background(tmp_path, *bridge):
            ros = RosSide(session)
            limp = ros.first("joint_states", "sensor_msgs/msg/JointState")
            ros.trigger("arm")
            ros.command(["joint_99"], position=[0.3])
            ros.command(["joint_7", "joint_8"], position=[0.3])
            there = ros.moved(
                lambda: ros.command(["joint_7"], position=[0.3]), lambda now: now["joint_7"] > 0.28
            )
            # The others hold their angles between pegs, which give: a position loop is as stiff as its gains.
            others = [
                abs(there[name] - was) for name, was in zip(limp.name, limp.position, strict=True)
            ]
            assert sorted(others)[-2] < 0.15
            assert there["joint_7"] == pytest.approx(0.3, abs=0.03)
            ros.moved(
                lambda: ros.command(["joint_3"], velocity=[-0.5]), lambda now: now["joint_3"] < -0.2
            )
            ros.first(
                "joint_states",
                "sensor_msgs/msg/JointState",
                lambda now: max(abs(now.velocity)) < 0.05,
            )
            stood = ros.first("joint_states", "sensor_msgs/msg/JointState")
            later = stood.header.stamp.sec + 3
            stands = ros.first(
                "joint_states",
                "sensor_msgs/msg/JointState",
                lambda now: now.header.stamp.sec >= later,
            )
            assert max(abs(stands.position - stood.position)) < 0.02
            ros.trigger("stop")
            refused = ros.asked(
                "arm", "std_srvs/srv/Trigger", ros.made("std_srvs/srv/Trigger_Request", 0)
            )
            assert not refused.success
            assert "stop" in refused.message
            ros.trigger("reset")
            ros.trigger("arm")
            ros.trigger("disarm")


def _tunes(ros: RosSide) -> None:
    """`ros2 param list`, `describe`, `set` and `get`."""
    name = "control.speed_kp_s"
    listed = ros.parameters("list_parameters", "ListParameters", [], 0)
    assert name in listed.result.names
    (about,) = ros.parameters("describe_parameters", "DescribeParameters", [name]).descriptors
    assert about.name == name
    assert about.type == 3
    assert "[s]" in about.description
    assert about.floating_point_range
    wanted = ros.parameter(name, 0.3)
    (done,) = ros.parameters("set_parameters", "SetParameters", [wanted]).results
    assert done.successful, done.reason
    (now, nothing) = ros.parameters("get_parameters", "GetParameters", [name, "control.x"]).values
    assert now.type == 3
    assert now.double_value == 0.3
    assert nothing.type == 0
    wanted = ros.parameter(name, -1.0)
    refused = ros.parameters(
        "set_parameters_atomically", "SetParametersAtomically", [wanted]
    ).result
    assert not refused.successful
    assert "speed_kp_s" in refused.reason


def _sees(ros: RosSide) -> None:
    described = ros.first("robot_description", "std_msgs/msg/String", latched=True)
    assert described.data.count("<joint") == 14
    joints = ros.first("joint_states", "sensor_msgs/msg/JointState")
    assert len(joints.name) == len(joints.position) == len(joints.effort) == 13
    clock = ros.first("clock", "rosgraph_msgs/msg/Clock").clock
    assert abs(clock.sec - joints.header.stamp.sec) <= 2
    image = ros.first("head/depth/image_raw", "sensor_msgs/msg/Image")
    assert image.encoding == "16UC1"
    assert image.width == 160
    assert image.height == 120
    assert len(image.data) == 38400
    png = ros.first("head/depth/image_raw/compressedDepth", "sensor_msgs/msg/CompressedImage")
    assert png.format == "16UC1; compressedDepth png"
    assert png.data[12:20].tobytes() == b"\x89PNG\r\n\x1a\n"
    imu = ros.first("link_7/imu", "sensor_msgs/msg/Imu")
    assert imu.header.frame_id == "link_7_imu_frame"
    assert 8 < imu.linear_acceleration.z < 12
    wrench = ros.first("link_3/contact", "geometry_msgs/msg/WrenchStamped")
    assert wrench.header.frame_id == "link_3"
    assert abs(wrench.wrench.force.y) < 1000
    info = ros.first("head/depth/camera_info", "sensor_msgs/msg/CameraInfo")
    assert info.header.frame_id == image.header.frame_id
    assert info.k[0] == info.p[0] > 0
    placed = "link_7_imu_frame"
    static = ros.first(
        "tf_static",
        "tf2_msgs/msg/TFMessage",
        lambda found: placed in {one.child_frame_id for one in found.transforms},
        latched=True,
    ).transforms
    assert image.header.frame_id in {one.child_frame_id for one in static}
    parents = {one.child_frame_id: one.header.frame_id for one in static}
    moving = ros.first(
        "tf", "tf2_msgs/msg/TFMessage", lambda found: len(found.transforms) == 13
    ).transforms
    base = ros.first(
        "tf", "tf2_msgs/msg/TFMessage", lambda found: len(found.transforms) == 1
    ).transforms
    parents |= {one.child_frame_id: one.header.frame_id for one in (*moving, *base)}
    frame, steps = image.header.frame_id, 0
    while frame != "map":
        frame, steps = parents[frame], steps + 1
    assert steps == 18  # optical, camera, 14 links, base, odom
    drawn = ros.first(
        "obstacles", "visualization_msgs/msg/MarkerArray", lambda found: len(found.markers) > 1
    )
    assert {marker.header.frame_id for marker in drawn.markers} == {"odom"}
    kinds = [token.split("/")[5] for token in ros.tokens()]
    assert kinds.count("NN") == 1
    assert kinds.count("MS") == 1
    assert kinds.count("MP") >= 9


def _steers(ros: RosSide, endpoint: str) -> None:
    """A Twist becomes an intent that navigation follows; without Twists the robot stops."""
    kind = {name: STORE.types[f"geometry_msgs/msg/{name}"] for name in ("Twist", "Vector3")}
    twist = kind["Twist"](kind["Vector3"](0.1, 0.0, 0.0), kind["Vector3"](0.0, 0.0, 0.2))
    payload = bytes(STORE.serialize_cdr(twist, "geometry_msgs/msg/Twist"))
    key = ros.key("cmd_vel", "geometry_msgs/msg/Twist")
    with open_session(ConnectionSettings(endpoint, "planar13_camera")) as robot:
        intents = robot.declare_reader(keys.INTENT, LocomotionIntent)
        plans = robot.declare_reader(keys.TRAJECTORY, Trajectory)

        def followed() -> bool:
            ros.session.put(key, payload)
            plan = plans.pop_newest(lambda _: True)
            return plan is not None and "ros2 /cmd_vel" in plan.reason and plan.speed_m_s > 0

        wait_until(followed, "navigation at the speed of /cmd_vel", 30.0)
        (*_, newest) = intents.drain()
        assert newest.speed_m_s == 0.1
        assert newest.heading_w_rad is not None
        assert abs(newest.heading_w_rad) < 3.2
        wait_until(
            lambda: (
                plans.pop_newest(lambda plan: plan.speed_m_s == 0 and "has expired" in plan.reason)
                is not None
            ),
            "standing still without /cmd_vel",
            30.0,
        )

        def sent(ago_s: float) -> bool:
            """Whether a Twist that its node sent so long ago becomes an intent."""
            timestamp_ns = time.time_ns() - round(ago_s * 1e9)
            ros.session.put(
                key,
                payload,
                attachment=struct.pack("<qqB16s", 7, timestamp_ns, 16, bytes(range(16))),
            )
            time.sleep(0.1)
            return bool(intents.drain())

        wait_until(lambda: sent(0.0), "a Twist of a moment ago", 10.0)
        time.sleep(0.5)
        intents.drain()
        assert not any(sent(14.0 - 0.1 * number) for number in range(5)), (
            "Twists that a network held back"
        )
        wait_until(lambda: sent(0.0), "the next Twist", 10.0)


def _outlasts_a_frozen_router(ros: RosSide, router: int, endpoint: str) -> None:
    """While nothing gets through to ROS the robot goes on, and afterwards so does the bridge."""
    images = ros.session.declare_subscriber(
        ros.key("head/depth/image_raw", "sensor_msgs/msg/Image"), handlers.RingChannel(1)
    )
    with open_session(ConnectionSettings(endpoint, "planar13_camera")) as robot:
        clocks = robot.declare_reader(keys.CLOCK, Clock)
        os.kill(router, signal.SIGSTOP)
        try:
            (first, *_) = _within(3.0, clocks)
            assert first.lifecycle == "armed"
            (*_, last) = _within(1.0, clocks)
            assert last.tick > first.tick
            assert last.lifecycle == "armed"
        finally:
            os.kill(router, signal.SIGCONT)
    images.undeclare()


def _within(seconds: float, clocks: SampleReader[Clock]) -> list[Clock]:
    time.sleep(seconds)
    return clocks.drain()
