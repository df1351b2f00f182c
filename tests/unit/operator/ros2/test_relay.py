"""Relays bound the rate at which samples of the robot reach ROS."""

from collections.abc import Sequence
from typing import Any

from snakesim_hal.wire.messages import Imu
from snakesim_operator.features.ros2.relay import ImuMeasurement, ImuRelay


class FakeSession:
    """A session whose reader has what a test gives it."""

    def __init__(self) -> None:
        self.samples: list[Imu] = []

    def declare_reader(self, *_key_and_type: Any, depth: int | None) -> "FakeSession":
        assert depth is None, "each sample may have an IMU that no other has"
        return self

    def drain(self) -> list[Imu]:
        drained = self.samples
        self.samples = []
        return drained


def sample(tick: int, links: Sequence[int]) -> Imu:
    return Imu(
        tick=tick,
        timestamp_ns=tick * 10_000_000,
        link=list(links),
        angular_velocity_rad_s=[(0.0, 0.0, 0.0)] * len(links),
        acceleration_m_s2=[(0.0, 0.0, 9.81)] * len(links),
    )


def test_an_imu_is_forwarded_at_most_once_in_a_cycle_and_none_is_lost() -> None:
    """IMUs measure at 100 Hz, some in every sample and some in every other; the bridge has cycles at 25 Hz."""
    session: Any = FakeSession()
    forwarded: list[dict[int, ImuMeasurement]] = []
    relay = ImuRelay(session, forwarded.append)
    for tick in range(16):
        session.samples.append(sample(tick, [0, 1] if tick % 2 == 0 else [0]))
        if tick % 4 == 3:
            relay.poll(tick // 4, lambda _: True)
    assert [sorted(measurements) for measurements in forwarded] == [[0, 1]] * 4
    assert [measurements[0].sample.tick for measurements in forwarded] == [3, 7, 11, 15]
    assert [measurements[1].sample.tick for measurements in forwarded] == [2, 6, 10, 14]
    assert forwarded[0][1].index_in_sample == 1


def test_a_sample_that_does_not_fit_the_robot_is_skipped() -> None:
    session: Any = FakeSession()
    forwarded: list[dict[int, ImuMeasurement]] = []
    session.samples = [sample(1, [0])]
    ImuRelay(session, forwarded.append).poll(0, lambda _: False)
    assert forwarded == []
