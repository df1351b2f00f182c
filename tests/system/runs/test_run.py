"""`snakesim run` with real processes completes in every clock mode, and names a computer that is too slow."""

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


def test_run_of_triplet_moves_forward_with_backward_handovers(tmp_path: Path) -> None:
    result, summary = run_to_summary(
        tmp_path / "run", "triplet", "--duration", "10", "--clock-mode", "lockstep"
    )
    assert result.code == 0, result.out + result.err
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
    assert str(tmp_path / "run" / REPORT_FILENAME) in result.out


@contextmanager
def starving_process(pid: int) -> Iterator[None]:
    """Give a process almost no processor time: four busy processes with priority share its core."""
    core = max(os.sched_getaffinity(0))
    busy_code = f"import os; os.sched_setaffinity(0, {{{core}}})\nwhile True: pass"
    # Each has its own session. If the kernel gives every session one share of the processor, a common session
    # would leave enough time to the process.
    load = [
        subprocess.Popen([sys.executable, "-c", busy_code], start_new_session=True)
        for _ in range(4)
    ]
    # The session of the process also has a share, if the kernel supports automatic groups.
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


@pytest.mark.quiet  # the test takes a core from every other test
def test_run_on_slow_computer_names_it_before_expired_lease(tmp_path: Path) -> None:
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
    with (
        running_armed_snakesim(tmp_path / "run", *arguments) as run,
        starving_process(run.part("control")),
    ):
        assert run.end() == 1, run.printed()
    ended = read_summary(tmp_path / "run").ended
    assert re.match(rf"{TOO_SLOW}(control|host) waited for a processor for \d+ of \d+ ms", ended), (
        ended
    )
    assert "; lease of control expired: " in ended
    assert f"fault: {TOO_SLOW}" in run.printed()


@pytest.mark.quiet
@pytest.mark.parametrize("clock_mode", ["realtime", "free"])
def test_run_in_realtime_and_free_mode_completes(tmp_path: Path, clock_mode: str) -> None:
    """In these clock modes a lease expires by the wall clock."""
    # 50 Hz has the longest lease, 100 ms: a busy test machine may pause a process for 50 ms.
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
    result, summary = run_to_summary(tmp_path / "run", *arguments)
    assert summary.clock_mode == clock_mode
    assert result.code == 0, result.out + result.err
    assert summary.ticks == 100, result.out + result.err
    if clock_mode == "realtime":
        assert summary.overruns or summary.real_time_factor == pytest.approx(1.0, abs=0.05)
        assert summary.state_to_command_us["p50"] is not None
        assert summary.tick_times.keys() == {"cycle", "late", "read", "write"}
        assert summary.tick_times["read"].count == 100
        assert summary.tick_times["cycle"].median_us > 15_000


@pytest.mark.slow  # in one process: test_advance.py
def test_run_until_goal_ends_with_its_mission(tmp_path: Path) -> None:
    arguments = [
        "--until-goal",
        "--set",
        "mission.goal.distance_m=0.4",
        "--duration",
        "8",
        "--clock-mode",
        "lockstep",
    ]
    result, summary = run_to_summary(tmp_path / "run", "surveyed_clutter", *arguments)
    assert result.code == 0, result.out + result.err
    assert summary.ended == "complete"
    assert 1.0 < summary.duration_s < 7.0
    assert "on request by snakesim run, at the goal" in (tmp_path / "run" / "host.json").read_text()
