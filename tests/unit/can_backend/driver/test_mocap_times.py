"""Stamps of another clock: order, lateness, and a clock that jumps."""

import random

import pytest

from snakesim_drivers.motion_capture.mocap_times import (
    MAX_LATENESS_NS,
    MIN_CONSISTENT_READINGS,
    CaptureTimes,
)

MS = 1_000_000
AHEAD_NS = 5_000_000_000_000  # what the other clock shows when ours shows 0


class Camera:
    """A camera with a clock of its own, and a reader that looks every 10 ms."""

    def __init__(self) -> None:
        self.times = CaptureTimes()
        self.ahead_ns = AHEAD_NS
        self.now_ns = 0

    def stamp(self, late_ms: float = 0.0) -> int:
        return self.now_ns - round(late_ms * MS) + self.ahead_ns

    def read(self, *late_ms: float) -> list[str | None]:
        """One reading, of samples that are late by so much, in their order."""
        self.now_ns += 10 * MS
        return list(self.times.check_timestamps([self.stamp(ms) for ms in late_ms], self.now_ns))

    def late_ms(self, timestamp_ns: int) -> float:
        return self.times.compute_lateness_ns(timestamp_ns, self.now_ns) / MS


def running(readings: int = 20) -> Camera:
    camera = Camera()
    for _ in range(readings):
        assert camera.read(0.0) == [None]
    return camera


def test_the_first_samples_may_be_the_slowest_of_all() -> None:
    camera = Camera()
    assert camera.read(40.0) == [None] and camera.late_ms(camera.stamp(40.0)) == 0.0, (
        "nothing faster is known yet"
    )
    assert camera.read(0.0) == [None]
    assert camera.late_ms(camera.stamp(40.0)) == pytest.approx(40.0)


def test_mocap_reader_after_a_pause_uses_newest_pose_without_jump() -> None:
    camera = running()
    camera.now_ns += 400 * MS
    assert camera.read(*range(390, -10, -10)) == ["late"] * 14 + [None] * 26
    assert camera.times.jump_count == 0


@pytest.mark.parametrize(
    ("late_ms", "why"), [(10.0, "duplicate"), (9.5, "duplicate"), (12.0, "reordered")]
)
def test_mocap_pose_that_is_not_newer_is_refused(late_ms: float, why: str) -> None:
    camera = running()
    assert camera.read(late_ms) == [why]
    assert camera.read(0.0) == [None]


def test_mocap_pose_too_old_or_in_future_is_refused() -> None:
    camera = running()
    camera.now_ns += 1000 * MS
    assert camera.read(MAX_LATENESS_NS / MS + 1) == ["late"]
    assert camera.read(MAX_LATENESS_NS / MS - 1) == [None]
    assert camera.read(-51.0) == ["future"]
    assert camera.read(0.0) == [None]
    assert camera.times.jump_count == 0


@pytest.mark.parametrize("jump_ms", [3_600_000, -3_600_000, 500, -500])
def test_a_clock_that_jumped_is_believed_after_some_readings(jump_ms: int) -> None:
    camera = running()
    camera.ahead_ns += jump_ms * MS
    verdicts = [camera.read(0.0)[0] for _ in range(MIN_CONSISTENT_READINGS + 5)]
    why = "future" if jump_ms > 0 else "reordered"
    assert verdicts == [why] * (MIN_CONSISTENT_READINGS - 1) + [None] * 6
    assert camera.times.jump_count == 1
    assert camera.late_ms(camera.stamp(3.0)) == pytest.approx(3.0), "by the new clock"


def test_strange_stamps_that_do_not_agree_are_never_believed() -> None:
    camera, rng = running(), random.Random(3)
    for _ in range(200):
        assert camera.read(-1000.0 * rng.randrange(1, 10**6)) == ["future"]
    assert camera.times.jump_count == 0
    assert camera.read(0.0) == [None]


def test_one_stamp_for_ever_is_a_duplicate_and_no_jump() -> None:
    camera = running()
    timestamp_ns = camera.stamp(0.0)
    for _ in range(100):
        camera.now_ns += 10 * MS
        assert camera.times.check_timestamps([timestamp_ns], camera.now_ns) == ["duplicate"]
    assert camera.times.jump_count == 0


@pytest.mark.parametrize("share", [1.0002, 0.9998])
def test_a_clock_that_drifts_stays_known(share: float) -> None:
    """Ten minutes: by then it is 120 ms off."""
    times = CaptureTimes()
    for tick in range(60_000):
        now_ns = tick * 10 * MS
        timestamp_ns = round(now_ns * share) + AHEAD_NS
        assert times.check_timestamps([timestamp_ns], now_ns) == [None]
        assert times.compute_lateness_ns(timestamp_ns, now_ns) < 5 * MS
    assert times.jump_count == 0
