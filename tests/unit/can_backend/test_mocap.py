"""Poses by UDP: the newest counts, and what is malformed is counted and left out."""

import json
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from snakesim_can_backend.mocap import MocapReceiver
from snakesim_hal.errors import ConfigError
from snakesim_hal.messages import Pose

GOOD: dict[str, Any] = {"position_w": [1.0, 2.0, 0.5], "orientation_wxyz": [1.0, 0.0, 0.0, 0.0]}
LIMIT_S = 5.0


@contextmanager
def receiver() -> Iterator[MocapReceiver]:
    mocap = MocapReceiver("127.0.0.1:0")
    try:
        yield mocap
    finally:
        mocap.close()


def send(mocap: MocapReceiver, *datagrams: object) -> None:
    host, _, port = mocap.address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            data = datagram if isinstance(datagram, bytes) else json.dumps(datagram).encode()
            sender.sendto(data, (host, int(port)))


def awaited(mocap: MocapReceiver, *, malformed: int | None = None) -> Pose | None:
    """The next pose; with `malformed`, whatever is there once so many were counted."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        pose = mocap.newest(7, 70_000_000)
        if pose is not None or mocap.malformed == malformed:
            return pose
        time.sleep(0.002)
    raise AssertionError("nothing came")


def test_nothing_came() -> None:
    with receiver() as mocap:
        assert mocap.newest(0, 0) is None and mocap.malformed == 0


def test_a_pose_is_stamped_by_the_receiver_and_taken_once() -> None:
    with receiver() as mocap:
        send(mocap, GOOD)
        pose = awaited(mocap)
        assert pose is not None and (pose.tick, pose.stamp_ns) == (7, 70_000_000)
        assert pose.position_w == (1.0, 2.0, 0.5) and pose.orientation_wxyz == (1.0, 0.0, 0.0, 0.0)
        assert mocap.newest(8, 80_000_000) is None


def test_the_newest_counts() -> None:
    with receiver() as mocap:
        send(mocap, *({**GOOD, "position_w": [float(i), 0.0, 0.0]} for i in range(5)))
        seen: Pose | None = None
        end = time.monotonic() + LIMIT_S
        while (seen is None or seen.position_w[0] != 4.0) and time.monotonic() < end:
            seen = mocap.newest(0, 0) or seen
        assert seen is not None and seen.position_w[0] == 4.0


def test_velocities_that_are_told_are_taken() -> None:
    with receiver() as mocap:
        send(mocap, {**GOOD, "velocity_w": [0.0, 0.0, 0.0], "angular_velocity_w": [0.1, 0.2, 0.3]})
        pose = awaited(mocap)
        assert pose is not None and pose.velocity_w == (0.0, 0.0, 0.0) and pose.angular_velocity_w == (0.1, 0.2, 0.3)


def test_a_velocity_that_is_not_told_is_the_change_of_position_over_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    with receiver() as mocap:
        send(mocap, GOOD)
        first = awaited(mocap)
        assert first is not None and first.velocity_w == (0.0, 0.0, 0.0)
        send(mocap, {**GOOD, "position_w": [1.1, 1.8, 0.5]})
        assert mocap._last is not None
        mocap._last = (mocap._last[0], now[0])
        now[0] += 0.1
        poses: list[Pose] = []
        end = time.monotonic() + LIMIT_S
        with monkeypatch.context() as patched:
            patched.setattr("snakesim_can_backend.mocap.time.monotonic", lambda: now[0])
            for _ in range(1000):
                if (pose := mocap.newest(1, 1)) is not None:
                    poses.append(pose)
                    break
                time.sleep(0.002)
        assert time.monotonic() < end + LIMIT_S
        assert poses[0].velocity_w == pytest.approx((1.0, -2.0, 0.0))


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"noise",
        b"\xff\xfe",
        b"{}",
        b"[]",
        {"position_w": [0.0, 0.0, 0.0]},
        {**GOOD, "position_w": [0.0, 0.0]},
        {**GOOD, "position_w": ["a", 0.0, 0.0]},
        {**GOOD, "position_w": [1e300, 0.0, 0.0]},
        {**GOOD, "orientation_wxyz": [2.0, 0.0, 0.0, 0.0]},
        b'{"position_w": [NaN, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        b'{"position_w": [1e999, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        {**GOOD, "name": "x" * 3000},
    ],
)
def test_what_is_malformed_is_counted_and_the_next_is_taken(datagram: object) -> None:
    with receiver() as mocap:
        send(mocap, datagram)
        assert awaited(mocap, malformed=1) is None and mocap.malformed == 1
        send(mocap, GOOD)
        assert awaited(mocap) is not None


def test_a_port_that_is_taken_is_told() -> None:
    with receiver() as mocap, pytest.raises(ConfigError, match=r"backends\.can\.pose_listen.*choose another port"):
        MocapReceiver(mocap.address)


def test_a_port_that_is_none_is_told() -> None:
    with pytest.raises(ConfigError, match="70000"):
        MocapReceiver("127.0.0.1:70000")


def test_without_a_host_it_listens_on_loopback() -> None:
    mocap = MocapReceiver(":0")
    assert mocap.address.startswith("127.0.0.1:")
    mocap.close()
