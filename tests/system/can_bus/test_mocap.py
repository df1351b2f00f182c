"""A receiver of poses over UDP returns the newest valid pose, and counts and ignores invalid datagrams."""

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

NS_PER_MS = 1_000_000
TICK_NS = 10 * NS_PER_MS
SENDER_CLOCK_AHEAD_NS = 5000 * NS_PER_MS
VELOCITIES: dict[str, Any] = {
    "velocity_w": [0.0, 0.0, 0.0],
    "angular_velocity_w": [0.1, 0.2, 0.3],
}
POSE_WITHOUT_VELOCITIES: dict[str, Any] = {
    "timestamp_ns": 0,
    "position_w": [1.0, 2.0, 0.5],
    "orientation_wxyz": [1.0, 0.0, 0.0, 0.0],
}
VALID_POSE = {**POSE_WITHOUT_VELOCITIES, **VELOCITIES}


class ReceiverWithTestClock(MocapReceiver):
    """A receiver whose clock only the test advances."""

    def __init__(self, delay_s: float = 0.0) -> None:
        self.now_ns = 10**9
        super().__init__("127.0.0.1:0", delay_s, lambda _timestamp_ns: self.now_ns)

    def read_next_tick(self) -> Pose | None:
        """Advance the clock by a tick, and return the newest pose."""
        self.now_ns += TICK_NS
        return self.read_newest(7, self.now_ns)

    def make_datagram(self, late_ms: float = 0.0, **values: Any) -> dict[str, Any]:
        """Make a datagram that is captured at the next tick, by a clock that is 5 s ahead."""
        captured_ns = self.now_ns + TICK_NS - round(late_ms * NS_PER_MS)
        return {**VALID_POSE, "timestamp_ns": captured_ns + SENDER_CLOCK_AHEAD_NS, **values}


@contextmanager
def open_receiver(delay_s: float = 0.0) -> Iterator[ReceiverWithTestClock]:
    """Open a receiver, and close it at the end."""
    mocap = ReceiverWithTestClock(delay_s)
    try:
        yield mocap
    finally:
        mocap.close()


def send(mocap: MocapReceiver, *datagrams: object) -> None:
    """Send datagrams over loopback; they have arrived when this function returns."""
    host, _, port = mocap.address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            data = datagram if isinstance(datagram, bytes) else json.dumps(datagram).encode()
            sender.sendto(data, (host, int(port)))


def send_and_read(mocap: ReceiverWithTestClock, *datagrams: object) -> Pose | None:
    """Send datagrams and read the pose a tick later."""
    send(mocap, *datagrams)
    return mocap.read_next_tick()


def test_mocap_pose_is_returned_once() -> None:
    with open_receiver() as mocap:
        pose = send_and_read(mocap, mocap.make_datagram())
        assert pose is not None
        assert pose.tick == 7
        assert pose.timestamp_ns == mocap.now_ns
        assert pose.position_w == (1.0, 2.0, 0.5)
        assert pose.orientation_wxyz == (1.0, 0.0, 0.0, 0.0)
        assert pose.velocity_w == (0.0, 0.0, 0.0)
        assert pose.angular_velocity_w == (0.1, 0.2, 0.3)
        assert mocap.read_next_tick() is None


def test_mocap_timestamps_increase_although_a_tick_is_late() -> None:
    with open_receiver() as mocap:
        first = send_and_read(mocap, mocap.make_datagram())
        send(mocap, mocap.make_datagram())
        mocap.now_ns += (
            25 * NS_PER_MS
        )  # the pose of 15 ms ago is read in the tick that was due then
        second = mocap.read_newest(8, mocap.now_ns - 15 * NS_PER_MS)
        assert first is not None
        assert second is not None
        assert second.timestamp_ns == first.timestamp_ns + 1
        third = send_and_read(mocap, mocap.make_datagram())
        assert third is not None
        assert third.timestamp_ns == mocap.now_ns


def test_mocap_captured_before_robot_start_is_no_pose() -> None:
    with open_receiver(delay_s=0.02) as mocap:
        for timestamp_ns, known in ((0, False), (10 * NS_PER_MS, False), (20 * NS_PER_MS, True)):
            send(mocap, mocap.make_datagram())
            mocap.now_ns += 10 * NS_PER_MS
            pose = mocap.read_newest(0, timestamp_ns)
            assert (pose is not None) is known
            assert pose is None or pose.timestamp_ns == 0


def make_position_datagram(
    mocap: ReceiverWithTestClock, x_m: float, late_ms: float = 0.0
) -> dict[str, Any]:
    """Make a datagram with a position only, from which the receiver computes the velocities."""
    datagram = mocap.make_datagram(late_ms, position_w=[x_m, 0.0, 0.0])
    return {name: value for name, value in datagram.items() if name not in VELOCITIES}


@pytest.mark.parametrize("late_ms", [0.0, 4.0, 9.0])
def test_mocap_velocity_uses_capture_times_not_arrival_times(late_ms: float) -> None:
    """The velocity is 0.5 m/s, however long the network delays the datagrams."""
    with open_receiver() as mocap:
        assert send_and_read(mocap, make_position_datagram(mocap, 0.0)) is None, (
            "a velocity was computed from one pose"
        )
        pose = send_and_read(
            mocap, make_position_datagram(mocap, 0.5 * (0.01 - late_ms * 1e-3), late_ms)
        )
        assert pose is not None
        assert pose.velocity_w == pytest.approx((0.5, 0.0, 0.0))


def test_mocap_angular_velocity_is_computed_from_rotation() -> None:
    with open_receiver() as mocap:
        send_and_read(mocap, make_position_datagram(mocap, 0.0))
        # 0.01 rad about z.
        turned = {
            **make_position_datagram(mocap, 0.0),
            "orientation_wxyz": [0.99998750, 0.0, 0.0, 0.00499998],
        }
        pose = send_and_read(mocap, turned)
        assert pose is not None
        assert pose.angular_velocity_w == pytest.approx((0.0, 0.0, 1.0), abs=1e-4)


def test_mocap_velocity_after_gap_is_known_with_second_pose() -> None:
    with open_receiver() as mocap:
        send_and_read(mocap, make_position_datagram(mocap, 0.0))
        mocap.now_ns += 300 * NS_PER_MS
        assert send_and_read(mocap, make_position_datagram(mocap, 0.1)) is None
        assert send_and_read(mocap, make_position_datagram(mocap, 0.1)) is not None
        for _ in range(5):
            jumped = {
                **make_position_datagram(mocap, 0.1),
                "timestamp_ns": mocap.now_ns + 10 * NS_PER_MS + 6000 * NS_PER_MS,
            }
            assert send_and_read(mocap, jumped) is None
        assert mocap.rejected_count_by_reason == {"future": 4}
        pose = send_and_read(
            mocap,
            {
                **make_position_datagram(mocap, 0.105),
                "timestamp_ns": mocap.now_ns + 10 * NS_PER_MS + 6000 * NS_PER_MS,
            },
        )
        assert pose is not None
        assert pose.velocity_w == pytest.approx((0.5, 0.0, 0.0))
        assert pose.timestamp_ns == mocap.now_ns


def test_mocap_impossible_leap_gives_no_velocity() -> None:
    with open_receiver() as mocap:
        send_and_read(mocap, make_position_datagram(mocap, 0.0))
        assert send_and_read(mocap, make_position_datagram(mocap, 1e6)) is None
        assert mocap.rejected_count_by_reason == {"leap": 1}
        pose = send_and_read(mocap, make_position_datagram(mocap, 1e6))
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
        {name: value for name, value in VALID_POSE.items() if name != "timestamp_ns"},
        {**VALID_POSE, "timestamp_ns": -1},
        {**VALID_POSE, "timestamp_ns": 2**63},
        {**VALID_POSE, "timestamp_ns": 1.5},
        {**VALID_POSE, "position_w": [0.0, 0.0]},
        {**VALID_POSE, "position_w": ["a", 0.0, 0.0]},
        {**VALID_POSE, "position_w": [1e300, 0.0, 0.0]},
        {**VALID_POSE, "orientation_wxyz": [0.5, 0.0, 0.0, 0.0]},
        b'{"timestamp_ns": 1, "position_w": [NaN, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        b'{"timestamp_ns": 1, "position_w": [1e999, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}',
        {**VALID_POSE, "name": "x" * 3000},
    ],
)
def test_mocap_malformed_datagram_is_counted_and_next_one_used(datagram: object) -> None:
    with open_receiver() as mocap:
        assert send_and_read(mocap, datagram) is None
        assert mocap.rejected_count_by_reason == {"malformed": 1}
        assert send_and_read(mocap, mocap.make_datagram()) is not None


def test_mocap_flood_is_limited_per_tick_and_soon_read(caplog: pytest.LogCaptureFixture) -> None:
    with open_receiver() as mocap:
        ticks = 0
        send(mocap, *([b'{"a":' + b"[" * 2000] * 5000))
        while True:
            count_before = mocap.rejected_count_by_reason["malformed"]
            if mocap.read_next_tick() is not None:
                break
            ticks += 1
            read_count = mocap.rejected_count_by_reason["malformed"] - count_before
            assert read_count <= MAX_DATAGRAMS_PER_CYCLE
            if not read_count:
                break
        assert ticks < 10, "the datagrams in the kernel's buffer are not read soon"
        assert send_and_read(mocap, mocap.make_datagram()) is not None
    assert [record.message.split(":")[1] for record in caplog.records] == [
        " first malformed datagram",
        " datagrams rejected",
    ]


def test_mocap_broken_socket_raises_backend_error() -> None:
    with open_receiver() as mocap:
        mocap._socket.close()
        with raises_error(BackendError, code="network/port-in-use"):
            mocap.read_next_tick()


@pytest.mark.parametrize("address", ["127.0.0.1:70000", "127.0.0.1:port", f"{'x' * 70}:1"])
def test_mocap_invalid_address_is_refused(address: str) -> None:
    with raises_error(ConfigError, code="network/invalid-address", field="pose_listen"):
        MocapReceiver(address, 0.0, lambda timestamp_ns: timestamp_ns)


def test_mocap_address_without_host_listens_on_loopback() -> None:
    mocap = MocapReceiver(":0", 0.0, lambda timestamp_ns: timestamp_ns)
    assert mocap.address.startswith("127.0.0.1:")
    mocap.close()
