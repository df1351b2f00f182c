"""A7: datagrams at the port that receives poses from motion capture.

Neither wrong datagrams nor more datagrams than a tick may read end the host.
"""

import json
import random
import socket
import time
from pathlib import Path

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from verification.attack.command import HOLD_POSE_FOR_AN_HOUR, parse_endpoint
from verification.attack.effort import choose_effort
from verification.attack.robot import start_armed_robot

POSE = {"timestamp_ns": 0, "position_w": [0.0, 0.0, 0.0], "orientation_wxyz": [1.0, 0.0, 0.0, 0.0]}


def make_pose_datagram(timestamp_ns: int | None = None) -> bytes:
    """Return a datagram with a valid pose, captured at a time; None for now."""
    if timestamp_ns is None:
        timestamp_ns = time.monotonic_ns()
    return json.dumps({**POSE, "timestamp_ns": timestamp_ns}).encode()


def make_wrong_datagrams() -> list[bytes]:
    """Return datagrams that are nested too deeply, random, truncated, or contain impossible values."""
    generator = random.Random(1)
    return [
        b'{"a":' + b"[" * 2000,
        b"[" * 2000,
        b'{"position_w":' + b"[" * 1900,
        b'{"a":' * 300,
        b"",
        b"\xff" * 2048,
        b'{"timestamp_ns": 0, "position_w": [1e999, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        b'{"timestamp_ns": 0, "position_w": [NaN, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        *(make_pose_datagram(timestamp_ns) for timestamp_ns in (-1, 0, 2**62, 10**400)),
        json.dumps({**POSE, "orientation_wxyz": [0, 0, 0, 0]}).encode(),
        json.dumps({**POSE, "position_w": [10**400, 0, 0]}).encode(),
        json.dumps({**POSE, "more": "x" * 40_000}).encode(),
        *(generator.randbytes(generator.randrange(1, 3000)) for _ in range(50)),
        *(make_pose_datagram()[:size] for size in range(1, 60, 7)),
    ]


def test_a7_no_datagram_at_the_pose_port_ends_the_host(tmp_path: Path) -> None:
    _, port = parse_endpoint(find_free_endpoint())
    pose_address = ("127.0.0.1", port)
    setting = f'backends.can.pose_listen="127.0.0.1:{port}"'
    arguments = (*HOLD_POSE_FOR_AN_HOUR, "--backend", "can", "--set", setting)
    with start_armed_robot(tmp_path, *arguments) as robot:
        health = robot.record_health()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp_socket:
            for _ in range(choose_effort(3, 100)):
                for datagram in make_wrong_datagrams():
                    udp_socket.sendto(datagram, pose_address)
            robot.assert_stays("armed", 1.0)
            # More valid poses than a tick may read.
            for _ in range(choose_effort(20_000, 500_000)):
                udp_socket.sendto(make_pose_datagram(), pose_address)
        wait_until(robot.operator.is_following_controller, "applied commands", 10.0)
        robot.assert_unharmed(health)
