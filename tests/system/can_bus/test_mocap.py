"""Poses by UDP: the newest counts, what cannot be used is counted and left out, and no datagram does harm."""

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from snakesim_drivers.motion_capture.mocap import MAX_DATAGRAMS_PER_CYCLE, MocapReceiver
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire.messages import Pose
from snakesim_testing.messages import raises_error

MS = 1_000_000
TOLD: dict[str, Any] = {"velocity_w": [0.0, 0.0, 0.0], "angular_velocity_w": [0.1, 0.2, 0.3]}
BARE: dict[str, Any] = {
    "timestamp_ns": 0,
    "position_w": [1.0, 2.0, 0.5],
    "orientation_wxyz": [1.0, 0.0, 0.0, 0.0],
}
GOOD = {**BARE, **TOLD}


class Mocap(MocapReceiver):
    """A receiver whose clock stands still but for the test."""

    def __init__(self, delay_s: float = 0.0) -> None:
        self.now_ns = 10**9
        super().__init__("127.0.0.1:0", delay_s, lambda _timestamp_ns: self.now_ns)

    def read(self) -> Pose | None:
        """A tick later."""
        self.now_ns += 10 * MS
        return self.read_newest(7, self.now_ns)

    def at(self, late_ms: float = 0.0, **more: Any) -> dict[str, Any]:
        """A datagram that was captured at the next tick, by a clock that is 5 s ahead."""
        return {
            **GOOD,
            "timestamp_ns": self.now_ns + 10 * MS + 5000 * MS - round(late_ms * MS),
            **more,
        }


@contextmanager
def receiver(delay_s: float = 0.0) -> Iterator[Mocap]:
    mocap = Mocap(delay_s)
    try:
        yield mocap
    finally:
        mocap.close()


def send(mocap: MocapReceiver, *datagrams: object) -> None:
    """On loopback they are there when this returns."""
    host, _, port = mocap.address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            data = datagram if isinstance(datagram, bytes) else json.dumps(datagram).encode()
            sender.sendto(data, (host, int(port)))


def read(mocap: Mocap, *datagrams: object) -> Pose | None:
    """Send, and read a tick later."""
    send(mocap, *datagrams)
    return mocap.read()


def test_a_pose_is_taken_once() -> None:
    with receiver() as mocap:
        pose = read(mocap, mocap.at())
        assert pose is not None
        assert pose.tick == 7
        assert pose.timestamp_ns == mocap.now_ns
        assert pose.position_w == (1.0, 2.0, 0.5)
        assert pose.orientation_wxyz == (1.0, 0.0, 0.0, 0.0)
        assert pose.velocity_w == (0.0, 0.0, 0.0)
        assert pose.angular_velocity_w == (0.1, 0.2, 0.3)
        assert mocap.read() is None


def test_stamps_go_on_although_a_tick_is_late() -> None:
    with receiver() as mocap:
        first = read(mocap, mocap.at())
        send(mocap, mocap.at())
        mocap.now_ns += 25 * MS  # what came 15 ms ago is read now, in the tick that was due then
        second = mocap.read_newest(8, mocap.now_ns - 15 * MS)
        assert first is not None
        assert second is not None
        assert second.timestamp_ns == first.timestamp_ns + 1
        third = read(mocap, mocap.at())
        assert third is not None
        assert third.timestamp_ns == mocap.now_ns


def test_mocap_captured_before_robot_start_is_no_pose() -> None:
    with receiver(delay_s=0.02) as mocap:
        for timestamp_ns, known in ((0, False), (10 * MS, False), (20 * MS, True)):
            send(mocap, mocap.at())
            mocap.now_ns += 10 * MS
            pose = mocap.read_newest(0, timestamp_ns)
            assert (pose is not None) is known
            assert pose is None or pose.timestamp_ns == 0


def bare(mocap: Mocap, x: float, late_ms: float = 0.0) -> dict[str, Any]:
    """A datagram without velocities."""
    reported = mocap.at(late_ms, position_w=[x, 0.0, 0.0])
    return {name: value for name, value in reported.items() if name not in TOLD}


@pytest.mark.parametrize("late_ms", [0.0, 4.0, 9.0])
def test_mocap_velocity_uses_capture_times_not_arrival_times(late_ms: float) -> None:
    """0.5 m/s, whatever the network does to the datagrams meanwhile."""
    with receiver() as mocap:
        assert read(mocap, bare(mocap, 0.0)) is None, "one pose has no velocity"
        pose = read(mocap, bare(mocap, 0.5 * (0.01 - late_ms * 1e-3), late_ms))
        assert pose is not None
        assert pose.velocity_w == pytest.approx((0.5, 0.0, 0.0))


def test_a_turn_gives_the_angular_velocity() -> None:
    with receiver() as mocap:
        read(mocap, bare(mocap, 0.0))
        # 0.01 rad about z.
        turned = {**bare(mocap, 0.0), "orientation_wxyz": [0.99998750, 0.0, 0.0, 0.00499998]}
        pose = read(mocap, turned)
        assert pose is not None
        assert pose.angular_velocity_w == pytest.approx((0.0, 0.0, 1.0), abs=1e-4)


def test_mocap_velocity_after_gap_is_known_with_second_pose() -> None:
    with receiver() as mocap:
        read(mocap, bare(mocap, 0.0))
        mocap.now_ns += 300 * MS
        assert read(mocap, bare(mocap, 0.1)) is None
        assert read(mocap, bare(mocap, 0.1)) is not None
        for _ in range(5):
            jumped = {**bare(mocap, 0.1), "timestamp_ns": mocap.now_ns + 10 * MS + 6000 * MS}
            assert read(mocap, jumped) is None
        assert mocap.rejected_count_by_reason == {"future": 4}
        pose = read(
            mocap, {**bare(mocap, 0.105), "timestamp_ns": mocap.now_ns + 10 * MS + 6000 * MS}
        )
        assert pose is not None
        assert pose.velocity_w == pytest.approx((0.5, 0.0, 0.0))
        assert pose.timestamp_ns == mocap.now_ns


def test_a_leap_that_no_body_makes_is_no_velocity() -> None:
    with receiver() as mocap:
        read(mocap, bare(mocap, 0.0))
        assert read(mocap, bare(mocap, 1e6)) is None
        assert mocap.rejected_count_by_reason == {"leap": 1}
        pose = read(mocap, bare(mocap, 1e6))
        assert pose is not None
        assert pose.velocity_w == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"noise",
        b"\xff\xfe",
        b"{}",
        b"[]",
        b'{"a":' + b"[" * 2000,
        b'{"a":' * 400,
        b'{"position_w":[' + b"9" * 2000,
        {"position_w": [0.0, 0.0, 0.0]},
        {name: value for name, value in GOOD.items() if name != "timestamp_ns"},
        {**GOOD, "timestamp_ns": -1},
        {**GOOD, "timestamp_ns": 2**63},
        {**GOOD, "timestamp_ns": 1.5},
        {**GOOD, "position_w": [0.0, 0.0]},
        {**GOOD, "position_w": ["a", 0.0, 0.0]},
        {**GOOD, "position_w": [1e300, 0.0, 0.0]},
        {**GOOD, "orientation_wxyz": [0.5, 0.0, 0.0, 0.0]},
        b'{"timestamp_ns": 1, "position_w": [NaN, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        b'{"timestamp_ns": 1, "position_w": [1e999, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        {**GOOD, "name": "x" * 3000},
    ],
)
def test_what_is_malformed_is_counted_and_the_next_is_taken(datagram: object) -> None:
    with receiver() as mocap:
        assert read(mocap, datagram) is None
        assert mocap.rejected_count_by_reason == {"malformed": 1}
        assert read(mocap, mocap.at()) is not None


def test_a_flood_is_bounded_per_tick_and_soon_over(caplog: pytest.LogCaptureFixture) -> None:
    with receiver() as mocap:
        ticks = 0
        send(mocap, *([b'{"a":' + b"[" * 2000] * 5000))
        while (before := mocap.rejected_count_by_reason["malformed"]) >= 0 and mocap.read() is None:
            ticks += 1
            read_now = mocap.rejected_count_by_reason["malformed"] - before
            assert read_now <= MAX_DATAGRAMS_PER_CYCLE
            if not read_now:
                break
        assert ticks < 10, "what the kernel keeps is soon read"
        assert read(mocap, mocap.at()) is not None
    assert [record.message.split(":")[1] for record in caplog.records] == [
        " first malformed datagram",
        " datagrams rejected",
    ]


def test_a_socket_that_breaks_is_an_error_of_the_backend() -> None:
    with receiver() as mocap:
        mocap._socket.close()
        with raises_error(BackendError, code="network/port-in-use"):
            mocap.read()


@pytest.mark.parametrize("address", ["127.0.0.1:70000", "127.0.0.1:port", f"{'x' * 70}:1"])
def test_an_address_that_is_none_is_told(address: str) -> None:
    with raises_error(ConfigError, code="network/invalid-address", field="pose_listen"):
        MocapReceiver(address, 0.0, lambda timestamp_ns: timestamp_ns)


def test_without_a_host_it_listens_on_loopback() -> None:
    mocap = MocapReceiver(":0", 0.0, lambda timestamp_ns: timestamp_ns)
    assert mocap.address.startswith("127.0.0.1:")
    mocap.close()
