"""What the console shows of a recorded run: the robot's own words of that instant, as a live page has them."""

from pathlib import Path

from snakesim_hal.model.scenario import load, parse_set
from snakesim_operator.console import texts
from snakesim_operator.console.recorded import RecordedRun
from snakesim_operator.results.record import RunRecord
from snakesim_operator.run.in_process import simulate


def test_state_faults_and_supply_are_those_of_the_instant(tmp_path: Path) -> None:
    sets = ["duration_s=2", 'faults=["nan:joint_3@1"]']
    simulate(load("triplet", [parse_set(one) for one in sets]).config, tmp_path / "run")
    recorded = RecordedRun(RunRecord.load(tmp_path / "run"), tmp_path / "run")
    moving, (_, end_s) = recorded.at(0.5), recorded.span_s
    assert moving.status is not None and moving.status.lifecycle == "armed" and not moving.status.faults
    assert moving.power is not None and "armed by" in texts.header(moving, recorded="run")
    over = recorded.at(end_s)
    assert over.status is not None and over.status.lifecycle == "fault"
    assert "joint_3" in texts.state_table(over) and "FAULT" in texts.header(over, recorded="run")
