"""The live line of a run."""

import pytest

from snakesim_hal.wire.messages import LifecycleState, RobotStatus
from snakesim_operator.run.progress import RunProgress
from snakesim_testing.hal.small_robots import make_run_config, make_status


def at(tick: int, lifecycle: LifecycleState = "armed") -> RobotStatus:
    return make_status(tick=tick, timestamp_ns=tick * 10**7, lifecycle=lifecycle, reason=lifecycle)


def shown(progress: RunProgress, found: RobotStatus, capsys: pytest.CaptureFixture[str]) -> str:
    progress._next_update_s = 0.0  # pyright: ignore[reportPrivateUsage] - as if it were time to
    progress.update(found, None, armed=True)
    return capsys.readouterr().out.strip() or progress._last_text.strip()  # pyright: ignore[reportPrivateUsage]


def test_only_armed_time_counts_and_never_more_than_all(capsys: pytest.CaptureFixture[str]) -> None:
    """With --stay a run goes on until it was armed for its duration."""
    progress, line = RunProgress(make_run_config(duration_s=3.0)), ""
    for tick in range(100, 301, 20):
        line = shown(progress, at(tick), capsys)
    assert line.startswith("2.00 of 3 s")
    for tick in range(320, 2001, 20):  # seventeen seconds in which a person looks at the fault
        line = shown(progress, at(tick, "fault"), capsys)
    assert line.startswith("2.20 of 3 s")
    assert "fault: fault" in line
    for tick in range(2020, 2200, 20):
        line = shown(progress, at(tick), capsys)
    assert line.startswith("3.00 of 3 s")


def test_progress_restarts_with_a_new_host(capsys: pytest.CaptureFixture[str]) -> None:
    progress = RunProgress(make_run_config(duration_s=3.0))
    for tick in (100, 200):
        shown(progress, at(tick), capsys)
    progress.reset()
    shown(progress, at(0), capsys)
    assert shown(progress, at(50), capsys).startswith("0.50 of 3 s")


def test_the_time_that_is_left_follows_from_the_speed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    progress = RunProgress(make_run_config(duration_s=300.0))
    shown(progress, at(0), capsys)
    now_s[0] += 10.0
    assert "2.0x real time  about 2:20 left" in shown(progress, at(2000), capsys)
    assert "left" not in shown(progress, at(2000, "fault"), capsys), "nobody knows when it goes on"
