"""`snakesim ros2` in real processes: what a ROS node would see on its own router, and what it may ask of the robot.

The ROS side is plain Zenoh with rmw_zenoh's keys, and rosbags for the messages; nothing of the bridge is imported.
"""

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh import ext, handlers  # pyright: ignore[reportMissingModuleSource]

from snakesim_hal.network.session import Link, Reader, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Intent, Trajectory
from tests.e2e.command import SNAKESIM, environment, running, snakesim
from tests.harness.endpoint import free_endpoint
from tests.harness.wait import wait_until

pytestmark = pytest.mark.e2e

STORE = get_typestore(Stores.ROS2_JAZZY)
ROUTER = '{mode: "router", listen: {endpoints: ["%s"]}, scouting: {multicast: {enabled: false}}}'
RUN = ("clutter", "--pace", "lockstep", "--duration", "600", "--stay", "--set", "rate_hz=50")


@contextmanager
def command(home: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A command in the background, killed at the end."""
    with subprocess.Popen(
        [*SNAKESIM, *arguments], cwd=home, env=environment(home), stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGKILL)


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
        self, topic: str, kind: str, wanted: Callable[[Any], bool] = lambda _: True, *, latched: bool = False
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
                assert sample.attachment is not None and len(sample.attachment.to_bytes()) == 33
                if wanted(found := STORE.deserialize_cdr(sample.payload.to_bytes(), kind)):
                    return found
        finally:
            declared.undeclare()
        raise AssertionError(f"nothing wanted on {topic} within 30 s")

    def tokens(self) -> list[str]:
        replies = self.session.liveliness().get("@ros2_lv/0/**", timeout=2.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def test_a_robot_among_ros_nodes(tmp_path: Path) -> None:
    at = free_endpoint()
    (tmp_path / "ros.json5").write_text(ROUTER % at)
    with running(tmp_path / "run", *RUN) as run, command(tmp_path, "router", "ros.json5") as router:
        run.wait_for(" s  ")
        refused = snakesim("ros2", "--endpoint", run.endpoint, "--ros-router", run.endpoint, cwd=tmp_path)
        assert refused.code == 2 and "itself is on this endpoint" in refused.err
        bridge = ("ros2", "--endpoint", run.endpoint, "--ros-router", at, "--cmd-vel")
        with session_at(at) as session, command(tmp_path, *bridge):
            _sees(RosSide(session))
            _steers(RosSide(session), run.endpoint)
            _outlasts_a_frozen_router(RosSide(session), router.pid, run.endpoint)
            with session_at(at) as anew:
                RosSide(anew).first("joint_states", "sensor_msgs/msg/JointState")
        with session_at(at) as session:
            wait_until(lambda: not RosSide(session).tokens(), "the node gone from the ROS graph", 10.0)


def test_the_bridge_waits_for_a_robot_that_is_starting(tmp_path: Path) -> None:
    at, endpoint = free_endpoint(), free_endpoint()
    (tmp_path / "ros.json5").write_text(ROUTER % at)
    late = ("run", "triplet", "--pace", "lockstep", "--duration", "600", "--no-record", "--endpoint", endpoint)
    bridge = ("ros2", "--endpoint", endpoint, "--ros-router", at)
    with command(tmp_path, "router", "ros.json5"), session_at(at) as session, command(tmp_path, *bridge) as waiting:
        assert waiting.stdout is not None and "Waiting for it up to 60 s" in waiting.stdout.readline()
        with command(tmp_path, *late):
            RosSide(session).first("joint_states", "sensor_msgs/msg/JointState")


def _sees(ros: RosSide) -> None:
    described = ros.first("robot_description", "std_msgs/msg/String", latched=True)
    assert described.data.count("<joint") == 14
    joints = ros.first("joint_states", "sensor_msgs/msg/JointState")
    assert len(joints.name) == len(joints.position) == len(joints.effort) == 13
    clock = ros.first("clock", "rosgraph_msgs/msg/Clock").clock
    assert abs(clock.sec - joints.header.stamp.sec) <= 2
    image = ros.first("head/depth/image_raw", "sensor_msgs/msg/Image")
    assert (image.encoding, image.width, image.height, len(image.data)) == ("16UC1", 160, 120, 38400)
    png = ros.first("head/depth/image_raw/compressedDepth", "sensor_msgs/msg/CompressedImage")
    assert png.format == "16UC1; compressedDepth png" and png.data[12:20].tobytes() == b"\x89PNG\r\n\x1a\n"
    imu = ros.first("link_7/imu", "sensor_msgs/msg/Imu")
    assert imu.header.frame_id == "link_7_imu_frame" and 8 < imu.linear_acceleration.z < 12
    info = ros.first("head/depth/camera_info", "sensor_msgs/msg/CameraInfo")
    assert info.header.frame_id == image.header.frame_id and info.k[0] == info.p[0] > 0
    placed = "link_7_imu_frame"
    static = ros.first(
        "tf_static",
        "tf2_msgs/msg/TFMessage",
        lambda found: placed in {one.child_frame_id for one in found.transforms},
        latched=True,
    ).transforms
    assert image.header.frame_id in {one.child_frame_id for one in static}
    parents = {one.child_frame_id: one.header.frame_id for one in static}
    moving = ros.first("tf", "tf2_msgs/msg/TFMessage", lambda found: len(found.transforms) == 13).transforms
    base = ros.first("tf", "tf2_msgs/msg/TFMessage", lambda found: len(found.transforms) == 1).transforms
    parents |= {one.child_frame_id: one.header.frame_id for one in (*moving, *base)}
    frame, steps = image.header.frame_id, 0
    while frame != "map":
        frame, steps = parents[frame], steps + 1
    assert steps == 18  # optical, camera, 14 links, base, odom
    drawn = ros.first("obstacles", "visualization_msgs/msg/MarkerArray", lambda found: len(found.markers) > 1)
    assert {marker.header.frame_id for marker in drawn.markers} == {"odom"}
    kinds = [token.split("/")[5] for token in ros.tokens()]
    assert (kinds.count("NN"), kinds.count("MS")) == (1, 1) and kinds.count("MP") >= 9


def _steers(ros: RosSide, endpoint: str) -> None:
    """A Twist becomes an intent that navigation follows; without Twists the robot stops."""
    kind = {name: STORE.types[f"geometry_msgs/msg/{name}"] for name in ("Twist", "Vector3")}
    twist = kind["Twist"](kind["Vector3"](0.1, 0.0, 0.0), kind["Vector3"](0.0, 0.0, 0.2))
    payload = bytes(STORE.serialize_cdr(twist, "geometry_msgs/msg/Twist"))
    key = ros.key("cmd_vel", "geometry_msgs/msg/Twist")
    with open_session(Link(endpoint, "planar13_camera")) as robot:
        intents = robot.reader(keys.INTENT, Intent)
        plans = robot.reader(keys.TRAJECTORY, Trajectory)

        def followed() -> bool:
            ros.session.put(key, payload)
            plan = plans.newest(lambda _: True)
            return plan is not None and "ros2 /cmd_vel" in plan.reason and plan.speed_m_s > 0

        wait_until(followed, "navigation at the speed of /cmd_vel", 30.0)
        (*_, newest) = intents.drain()
        assert newest.speed_m_s == 0.1 and newest.heading_w_rad is not None and abs(newest.heading_w_rad) < 3.2
        wait_until(
            lambda: plans.newest(lambda plan: plan.speed_m_s == 0 and "has expired" in plan.reason) is not None,
            "standing still without /cmd_vel",
            30.0,
        )


def _outlasts_a_frozen_router(ros: RosSide, router: int, endpoint: str) -> None:
    """While nothing gets through to ROS the robot goes on, and afterwards so does the bridge."""
    images = ros.session.declare_subscriber(
        ros.key("head/depth/image_raw", "sensor_msgs/msg/Image"), handlers.RingChannel(1)
    )
    with open_session(Link(endpoint, "planar13_camera")) as robot:
        clocks = robot.reader(keys.CLOCK, Clock)
        os.kill(router, signal.SIGSTOP)
        try:
            (first, *_) = _within(3.0, clocks)
            assert first.lifecycle == "armed"
            (*_, last) = _within(1.0, clocks)
            assert last.tick > first.tick and last.lifecycle == "armed"
        finally:
            os.kill(router, signal.SIGCONT)
    images.undeclare()


def _within(seconds: float, clocks: Reader[Clock]) -> list[Clock]:
    time.sleep(seconds)
    return clocks.drain()
