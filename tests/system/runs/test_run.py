"""The main job, with real processes: it runs, it moves, and it repeats itself, however busy the machine is."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from snakesim_operator.results.run_reader import REPORT_FILENAME
from snakesim_testing.runs.command import (
    TOO_SLOW,
    read_summary,
    run_to_summary,
    running_armed_snakesim,
)

pytestmark = pytest.mark.e2e


def test_triplet_moves_forward_and_hands_over_backward(tmp_path: Path) -> None:
    ended, summary = run_to_summary(
        tmp_path / "run", "triplet", "--duration", "10", "--clock-mode", "lockstep"
    )
    assert ended.code == 0, ended.out + ended.err
    assert summary.path_distance_m is not None
    assert summary.path_distance_m >= 0.5
    joints = [int(name.removeprefix("joint_")) for name in summary.propulsion_joints or []]
    assert len(joints) >= 4
    assert joints == sorted(joints, reverse=True)
    assert summary.ticks == 1000
    assert summary.rejected_commands == {}
    assert summary.faults == []
    assert summary.answered_fraction == 1.0
    assert summary.backend == "sim"
    assert summary.config["scene"]["name"] == "triplet"
    assert (tmp_path / "run" / REPORT_FILENAME).stat().st_size > 20_000
    assert str(tmp_path / "run" / REPORT_FILENAME) in ended.out


@contextmanager
def starved(pid: int) -> Iterator[None]:
    """A process gets next to nothing of one processor: others need that, and go first."""
    core = max(os.sched_getaffinity(0))
    spin = f"import os; os.sched_setaffinity(0, {{{core}}})\nwhile True: pass"
    # Each in a session of its own: where a session has one share, all in one would leave enough to a quiet computer.
    load = [
        subprocess.Popen([sys.executable, "-c", spin], start_new_session=True) for _ in range(4)
    ]
    # Its session has a share of its own, where the kernel is made so.
    group = Path(f"/proc/{pid}/autogroup")
    if group.exists():
        group.write_text("19")
    for thread in Path(f"/proc/{pid}/task").iterdir():
        os.sched_setaffinity(int(thread.name), {core})
        os.sched_setscheduler(int(thread.name), os.SCHED_IDLE, os.sched_param(0))
    try:
        yield
    finally:
        for process in load:
            process.kill()
            process.wait()


@pytest.mark.slow  # it takes a core from every other test
def test_slow_computer_is_named_before_expired_lease(tmp_path: Path) -> None:
    arguments = [
        "triplet",
        "--controller",
        "hold",
        "--duration",
        "60",
        "--clock-mode",
        "realtime",
        "--set",
        "rate_hz=50",
    ]
    with running_armed_snakesim(tmp_path / "run", *arguments) as run, starved(run.part("control")):
        assert run.end() == 1, run.printed()
    ended = read_summary(tmp_path / "run").ended
    assert re.match(rf"{TOO_SLOW}(control|host) waited for a processor for \d+ of \d+ ms", ended), (
        ended
    )
    assert "; lease of control expired: " in ended
    assert f"fault: {TOO_SLOW}" in run.printed()


@pytest.mark.quiet
@pytest.mark.parametrize("clock_mode", ["realtime", "free"])
def test_other_paces_complete(tmp_path: Path, clock_mode: str) -> None:
    """In these clock modes a lease is one of the wall clock."""
    # 50 Hz has the longest lease, 100 ms: a busy test machine may well forget a process for 50 ms.
    arguments = [
        "triplet",
        "--controller",
        "hold",
        "--duration",
        "2",
        "--clock-mode",
        clock_mode,
        "--set",
        "rate_hz=50",
    ]
    # The host waits for nothing, so a recorder that joins late misses ticks.
    if clock_mode == "free":
        arguments.append("--no-record")
    ended, summary = run_to_summary(tmp_path / "run", *arguments)
    assert summary.clock_mode == clock_mode
    assert ended.code == 0 and summary.ticks == 100, ended.out + ended.err
    if clock_mode == "realtime":
        assert summary.overruns or summary.real_time_factor == pytest.approx(1.0, abs=0.05)
        assert summary.state_to_command_us["p50"] is not None
        assert summary.tick_times.keys() == {"cycle", "late", "read", "write"}
        assert summary.tick_times["read"].count == 100
        assert summary.tick_times["cycle"].median_us > 15_000


@pytest.mark.slow  # in one process: test_advance.py
def test_a_run_in_processes_may_end_with_its_mission(tmp_path: Path) -> None:
    short = [
        "--until-goal",
        "--set",
        "mission.goal.distance_m=0.4",
        "--duration",
        "8",
        "--clock-mode",
        "lockstep",
    ]
    ended, summary = run_to_summary(tmp_path / "run", "surveyed_clutter", *short)
    assert ended.code == 0, ended.out + ended.err
    assert summary.ended == "complete"
    assert 1.0 < summary.duration_s < 7.0
    assert "on request by snakesim run, at the goal" in (tmp_path / "run" / "host.json").read_text()
