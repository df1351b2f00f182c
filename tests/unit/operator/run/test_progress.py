"""The progress line that a run prints while it is active."""

import pytest

from snakesim_hal.wire.messages import LifecycleState, RobotStatus
from snakesim_operator.run.progress import RunProgress
from snakesim_testing.hal.small_robots import make_run_config, make_status


def make_status_at_tick(tick: int, lifecycle: LifecycleState = "armed") -> RobotStatus:
    """Make the status of a robot with 100 ticks in each second."""
    return make_status(tick=tick, timestamp_ns=tick * 10**7, lifecycle=lifecycle, reason=lifecycle)


def read_progress_line(
    progress: RunProgress, status: RobotStatus, capsys: pytest.CaptureFixture[str]
) -> str:
    """Update the progress with a status, and return its line."""
    progress._next_update_s = 0.0  # pyright: ignore[reportPrivateUsage] - as if it were time to
    progress.update(status, None, armed=True)
    return capsys.readouterr().out.strip() or progress._last_text.strip()  # pyright: ignore[reportPrivateUsage]


def test_progress_counts_only_armed_time_up_to_duration(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With --stay a run continues until it was armed for its whole duration."""
    progress = RunProgress(make_run_config(duration_s=3.0))
    line = ""
    for tick in range(100, 301, 20):
        line = read_progress_line(progress, make_status_at_tick(tick), capsys)
    assert line.startswith("2.00 of 3 s")
    for tick in range(320, 2001, 20):  # the robot stays in the fault state for 17 s
        line = read_progress_line(progress, make_status_at_tick(tick, "fault"), capsys)
    assert line.startswith("2.20 of 3 s")
    assert "fault: fault" in line
    for tick in range(2020, 2200, 20):
        line = read_progress_line(progress, make_status_at_tick(tick), capsys)
    assert line.startswith("3.00 of 3 s")


def test_progress_restarts_with_a_new_host(capsys: pytest.CaptureFixture[str]) -> None:
    progress = RunProgress(make_run_config(duration_s=3.0))
    for tick in (100, 200):
        read_progress_line(progress, make_status_at_tick(tick), capsys)
    progress.reset()
    read_progress_line(progress, make_status_at_tick(0), capsys)
    assert read_progress_line(progress, make_status_at_tick(50), capsys).startswith("0.50 of 3 s")


def test_progress_remaining_time_follows_from_speed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    progress = RunProgress(make_run_config(duration_s=300.0))
    read_progress_line(progress, make_status_at_tick(0), capsys)
    now_s[0] += 10.0
    assert "2.0x real time  about 2:20 left" in read_progress_line(
        progress, make_status_at_tick(2000), capsys
    )
    assert "left" not in read_progress_line(progress, make_status_at_tick(2000, "fault"), capsys), (
        "the end of a fault cannot be predicted"
    )
