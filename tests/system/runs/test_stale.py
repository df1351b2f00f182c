"""If joint states stop to arrive, the robot stops; if any other stream stops, the controller holds the robot."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import REPORT_FILENAME
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.runs.command import CompletedRun, run_to_summary

pytestmark = [pytest.mark.e2e, pytest.mark.quiet]

DROP_START_S = 2.0
DROP_END_S = 3.4
FADE_S = 0.9  # after the end of the push: three time constants of its fade


def run_with_fault(out: Path, fault: str) -> tuple[CompletedRun, RunSummary]:
    """Run the case study for 6 s in real time with this fault."""
    return run_to_summary(
        out, "triplet", "--clock-mode", "realtime", "--duration", "6", "--fault", fault
    )


def get_fault_time_s(out: Path, summary: RunSummary) -> float:
    """Return the time of the first fault since the start of the record."""
    return float(summary.faults[0].tick / summary.rate_hz - RunRecord.load(out).time_s[0])


def test_control_without_joint_states_stops_robot_and_reports_reason(tmp_path: Path) -> None:
    result, summary = run_with_fault(tmp_path / "run", f"drop:sensor/joints@{DROP_START_S}")
    assert result.code == 1
    assert summary.faults[0].what == "lease_expired"
    # A joint state may be 30 ms old, and a lease lasts 50 ms.
    assert DROP_START_S < get_fault_time_s(tmp_path / "run", summary) < DROP_START_S + 0.2
    assert "sensor/joints is 0.0" in (tmp_path / "run" / "control.log").read_text()
    assert "at most 0.03 s: no commands" in (tmp_path / "run" / "control.log").read_text()
    assert (
        "Control reported: sensor/joints is 0.0" in (tmp_path / "run" / REPORT_FILENAME).read_text()
    )


@pytest.mark.slow
def test_control_without_stream_holds_and_continues_when_it_returns(tmp_path: Path) -> None:
    """The fault table measures the other streams."""
    key = "guidance/world"
    max_age_s = 0.22
    result, summary = run_with_fault(tmp_path / "run", f"drop:{key}@{DROP_START_S}-{DROP_END_S}")
    assert result.code == 0, result.out
    assert summary.faults == [], result.out
    assert summary.ended == "complete", result.out
    record = RunRecord.load(tmp_path / "run")
    time_s = record.time_s - record.time_s[0]
    pushes = (record.mode == JointMode.TORQUE).any(axis=1)
    holds = (time_s > DROP_START_S + max_age_s + 0.1) & (time_s < DROP_END_S)
    assert pushes[time_s < DROP_START_S].any()
    assert not pushes[holds].any()
    assert pushes[time_s > DROP_END_S + 0.5].any()
    assert (record.mode[holds] == JointMode.POSITION).all()
    reported = [state for state in record.control_states if state.reason.startswith(f"{key} is 0.")]
    assert reported
    assert all(state.state == "NotLocomoting" for state in reported)
    assert any(f"s old, at most {max_age_s:g} s" in state.reason for state in reported)
    assert "Locomoting" in {state.state for state in record.control_states[-20:]}, (
        "in the last second"
    )
    faded = (time_s > DROP_START_S + max_age_s + FADE_S) & (time_s < DROP_END_S)
    if faded.any():  # then neither the robot nor a target moves any more
        assert np.ptp(record.target[faded], axis=0).max() < 0.02
        assert np.ptp(record.position_w_m[faded][:, 0]) < 0.01
