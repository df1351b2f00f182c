"""Timestamps of a motion capture clock: order, lateness, jumps and drift."""

import random

import pytest

from snakesim_drivers.motion_capture.mocap_times import (
    MAX_LATENESS_NS,
    MIN_CONSISTENT_READINGS,
    CaptureTimes,
)

NS_PER_MS = 1_000_000
CLOCK_OFFSET_NS = 5_000_000_000_000  # offset of the other clock


class Camera:
    """A camera with a clock of its own, and a reader that polls every 10 ms."""

    def __init__(self) -> None:
        self.times = CaptureTimes()
        self.clock_offset_ns = CLOCK_OFFSET_NS
        self.now_ns = 0

    def make_timestamp_ns(self, late_ms: float = 0.0) -> int:
        """Return what the clock of the camera showed some time ago."""
        return self.now_ns - round(late_ms * NS_PER_MS) + self.clock_offset_ns

    def read_samples(self, *late_ms: float) -> list[str | None]:
        """Return the verdicts about samples that arrive late by these times, in this order."""
        self.now_ns += 10 * NS_PER_MS
        return list(
            self.times.check_timestamps([self.make_timestamp_ns(ms) for ms in late_ms], self.now_ns)
        )

    def compute_lateness_ms(self, timestamp_ns: int) -> float:
        return self.times.compute_lateness_ns(timestamp_ns, self.now_ns) / NS_PER_MS


def make_running_camera(readings: int = 20) -> Camera:
    """Return a camera after some accepted readings."""
    camera = Camera()
    for _ in range(readings):
        assert camera.read_samples(0.0) == [None]
    return camera


def test_mocap_lateness_after_slow_first_sample_is_corrected() -> None:
    camera = Camera()
    assert (
        camera.read_samples(40.0) == [None]
        and camera.compute_lateness_ms(camera.make_timestamp_ns(40.0)) == 0.0
    ), "no faster sample is known yet"
    assert camera.read_samples(0.0) == [None]
    assert camera.compute_lateness_ms(camera.make_timestamp_ns(40.0)) == pytest.approx(40.0)


def test_mocap_reader_after_a_pause_uses_newest_pose_without_jump() -> None:
    camera = make_running_camera()
    camera.now_ns += 400 * NS_PER_MS
    assert camera.read_samples(*range(390, -10, -10)) == ["late"] * 14 + [None] * 26
    assert camera.times.jump_count == 0


@pytest.mark.parametrize(
    ("late_ms", "verdict"), [(10.0, "duplicate"), (9.5, "duplicate"), (12.0, "reordered")]
)
def test_mocap_pose_that_is_not_newer_is_refused(late_ms: float, verdict: str) -> None:
    camera = make_running_camera()
    assert camera.read_samples(late_ms) == [verdict]
    assert camera.read_samples(0.0) == [None]


def test_mocap_pose_too_old_or_in_future_is_refused() -> None:
    camera = make_running_camera()
    camera.now_ns += 1000 * NS_PER_MS
    assert camera.read_samples(MAX_LATENESS_NS / NS_PER_MS + 1) == ["late"]
    assert camera.read_samples(MAX_LATENESS_NS / NS_PER_MS - 1) == [None]
    assert camera.read_samples(-51.0) == ["future"]
    assert camera.read_samples(0.0) == [None]
    assert camera.times.jump_count == 0


@pytest.mark.parametrize("jump_ms", [3_600_000, -3_600_000, 500, -500])
def test_mocap_clock_jump_is_accepted_after_consistent_readings(jump_ms: int) -> None:
    camera = make_running_camera()
    camera.clock_offset_ns += jump_ms * NS_PER_MS
    verdicts = [camera.read_samples(0.0)[0] for _ in range(MIN_CONSISTENT_READINGS + 5)]
    first_verdict = "future" if jump_ms > 0 else "reordered"
    assert verdicts == [first_verdict] * (MIN_CONSISTENT_READINGS - 1) + [None] * 6
    assert camera.times.jump_count == 1
    assert camera.compute_lateness_ms(camera.make_timestamp_ns(3.0)) == pytest.approx(3.0), (
        "measured with the new clock"
    )


def test_mocap_inconsistent_future_timestamps_are_never_accepted() -> None:
    camera = make_running_camera()
    rng = random.Random(3)
    for _ in range(200):
        assert camera.read_samples(-1000.0 * rng.randrange(1, 10**6)) == ["future"]
    assert camera.times.jump_count == 0
    assert camera.read_samples(0.0) == [None]


def test_mocap_repeated_timestamp_is_a_duplicate_and_no_jump() -> None:
    camera = make_running_camera()
    timestamp_ns = camera.make_timestamp_ns(0.0)
    for _ in range(100):
        camera.now_ns += 10 * NS_PER_MS
        assert camera.times.check_timestamps([timestamp_ns], camera.now_ns) == ["duplicate"]
    assert camera.times.jump_count == 0


@pytest.mark.parametrize("clock_ratio", [1.0002, 0.9998])
def test_mocap_drifting_clock_keeps_samples_accepted(clock_ratio: float) -> None:
    """Check ten minutes, in which the clock drifts by 120 ms."""
    times = CaptureTimes()
    for tick in range(60_000):
        now_ns = tick * 10 * NS_PER_MS
        timestamp_ns = round(now_ns * clock_ratio) + CLOCK_OFFSET_NS
        assert times.check_timestamps([timestamp_ns], now_ns) == [None]
        assert times.compute_lateness_ns(timestamp_ns, now_ns) < 5 * NS_PER_MS
    assert times.jump_count == 0
