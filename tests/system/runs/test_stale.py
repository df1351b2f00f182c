"""Streams that stop in a run of real processes: joints stop the robot, all others make the controller hold."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import REPORT_FILENAME
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.runs.command import CompletedRun, run_to_summary

pytestmark = [pytest.mark.e2e, pytest.mark.quiet]

FROM_S, TO_S = 2.0, 3.4
FADED_S = 0.9  # after the push has ended: three time constants of the fade


def run_with_fault(out: Path, fault: str) -> tuple[CompletedRun, RunSummary]:
    return run_to_summary(
        out, "triplet", "--clock-mode", "realtime", "--duration", "6", "--fault", fault
    )


def stopped_after_s(out: Path, summary: RunSummary) -> float:
    return float(summary.faults[0].tick / summary.rate_hz - RunRecord.load(out).time_s[0])


def test_without_joints_the_robot_stops_and_the_reason_is_told(tmp_path: Path) -> None:
    ended, summary = run_with_fault(tmp_path / "run", f"drop:sensor/joints@{FROM_S}")
    assert ended.code == 1
    assert summary.faults[0].what == "lease_expired"
    # A state may be 30 ms old, a lease lasts 50 ms.
    assert FROM_S < stopped_after_s(tmp_path / "run", summary) < FROM_S + 0.2
    assert "sensor/joints is 0.0" in (tmp_path / "run" / "control.log").read_text()
    assert "at most 0.03 s: no commands" in (tmp_path / "run" / "control.log").read_text()
    assert "Control said: sensor/joints is 0.0" in (tmp_path / "run" / REPORT_FILENAME).read_text()


@pytest.mark.slow
def test_control_without_stream_holds_and_continues_when_it_returns(tmp_path: Path) -> None:
    """The others, one by one, are rows of the fault table."""
    key, limit_s = "guidance/world", 0.22
    ended, summary = run_with_fault(tmp_path / "run", f"drop:{key}@{FROM_S}-{TO_S}")
    assert ended.code == 0 and summary.faults == [] and summary.ended == "complete", ended.out
    record = RunRecord.load(tmp_path / "run")
    time_s = record.time_s - record.time_s[0]
    pushes = (record.mode == JointMode.TORQUE).any(axis=1)
    held = (time_s > FROM_S + limit_s + 0.1) & (time_s < TO_S)
    assert pushes[time_s < FROM_S].any()
    assert not pushes[held].any()
    assert pushes[time_s > TO_S + 0.5].any()
    assert (record.mode[held] == JointMode.POSITION).all()
    reported = [state for state in record.control_states if state.reason.startswith(f"{key} is 0.")]
    assert reported
    assert all(state.state == "NotLocomoting" for state in reported)
    assert any(f"s old, at most {limit_s:g} s" in state.reason for state in reported)
    assert "Locomoting" in {state.state for state in record.control_states[-20:]}, (
        "in the last second"
    )
    late = (time_s > FROM_S + limit_s + FADED_S) & (time_s < TO_S)
    if late.any():  # nothing moves any more, and no target moves
        assert np.ptp(record.target[late], axis=0).max() < 0.02
        assert np.ptp(record.position_w_m[late][:, 0]) < 0.01
