"""A7: datagrams from a motion-capture system, or from whoever sends to its port."""

import json
import random
import socket
import time
from pathlib import Path

from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.attack.command import STANDING, address
from verification.attack.effort import effort
from verification.attack.robot import standing

POSE = {"timestamp_ns": 0, "position_w": [0.0, 0.0, 0.0], "orientation_wxyz": [1.0, 0.0, 0.0, 0.0]}


def frame(timestamp_ns: int | None = None) -> bytes:
    """A good one, captured now."""
    return json.dumps(
        {**POSE, "timestamp_ns": time.monotonic_ns() if timestamp_ns is None else timestamp_ns}
    ).encode()


def wrong_poses() -> list[bytes]:
    dice = random.Random(1)
    return [
        b'{"a":' + b"[" * 2000,
        b"[" * 2000,
        b'{"position_w":' + b"[" * 1900,
        b'{"a":' * 300,
        b"",
        b"\xff" * 2048,
        b'{"timestamp_ns": 0, "position_w": [1e999, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        b'{"timestamp_ns": 0, "position_w": [NaN, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        *(frame(timestamp_ns) for timestamp_ns in (-1, 0, 2**62, 10**400)),
        json.dumps({**POSE, "orientation_wxyz": [0, 0, 0, 0]}).encode(),
        json.dumps({**POSE, "position_w": [10**400, 0, 0]}).encode(),
        json.dumps({**POSE, "more": "x" * 40_000}).encode(),
        *(dice.randbytes(dice.randrange(1, 3000)) for _ in range(50)),
        *(frame()[:cut] for cut in range(1, 60, 7)),
    ]


def test_a7_no_datagram_at_the_pose_port_ends_the_host(tmp_path: Path) -> None:
    port = address(find_free_endpoint())[1]
    pose = f'backends.can.pose_listen="127.0.0.1:{port}"'
    with standing(tmp_path, *STANDING, "--backend", "can", "--set", pose) as robot:
        before = robot.health()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            for _ in range(effort(3, 100)):
                for datagram in wrong_poses():
                    wire.sendto(datagram, ("127.0.0.1", port))
            robot.stays("armed", 1.0)
            for _ in range(effort(20_000, 500_000)):  # more than a tick may read
                wire.sendto(frame(), ("127.0.0.1", port))
        robot.operator.until(robot.operator.follows, "it follows its controller", 10.0)
        robot.unharmed(before)
