"""Checks that relays limit the rate of the samples that the bridge forwards to ROS."""

from collections.abc import Sequence
from typing import Any

from snakesim_hal.wire.messages import Imu
from snakesim_operator.features.ros2.relay import ImuMeasurement, ImuRelay


class FakeSession:
    """A session whose reader returns the samples that a test adds."""

    def __init__(self) -> None:
        self.samples: list[Imu] = []

    def declare_reader(self, *_key_and_type: Any, depth: int | None) -> "FakeSession":
        assert depth is None, "any sample may be the only one with a certain IMU"
        return self

    def drain(self) -> list[Imu]:
        drained = self.samples
        self.samples = []
        return drained


def make_imu_sample(tick: int, links: Sequence[int]) -> Imu:
    """Make a sample with one measurement of the IMU of each of these links."""
    return Imu(
        tick=tick,
        timestamp_ns=tick * 10_000_000,
        link=list(links),
        angular_velocity_rad_s=[(0.0, 0.0, 0.0)] * len(links),
        acceleration_m_s2=[(0.0, 0.0, 9.81)] * len(links),
    )


def test_imu_relay_forwards_each_imu_once_in_a_cycle() -> None:
    """Samples arrive at 100 Hz, every second one with both IMUs; the bridge has cycles at 25 Hz."""
    session: Any = FakeSession()
    forwarded: list[dict[int, ImuMeasurement]] = []
    relay = ImuRelay(session, forwarded.append)
    for tick in range(16):
        session.samples.append(make_imu_sample(tick, [0, 1] if tick % 2 == 0 else [0]))
        if tick % 4 == 3:
            relay.poll(tick // 4, lambda _: True)
    assert [sorted(measurements) for measurements in forwarded] == [[0, 1]] * 4
    assert [measurements[0].sample.tick for measurements in forwarded] == [3, 7, 11, 15]
    assert [measurements[1].sample.tick for measurements in forwarded] == [2, 6, 10, 14]
    assert forwarded[0][1].index_in_sample == 1


def test_imu_relay_skips_sample_of_another_robot() -> None:
    session: Any = FakeSession()
    forwarded: list[dict[int, ImuMeasurement]] = []
    session.samples = [make_imu_sample(1, [0])]
    ImuRelay(session, forwarded.append).poll(0, lambda _: False)
    assert forwarded == []
