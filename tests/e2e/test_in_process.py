"""A run in one process does to the bit what processes do over a network."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.model.files import shipped
from snakesim_hal.model.scenario import read
from snakesim_operator.results.record import CONFIG
from snakesim_operator.results.record import RunRecord as Record
from snakesim_operator.run.in_process import Result, simulate
from tests.e2e.command import run_to_summary

pytestmark = pytest.mark.e2e


def same_both_ways(out: Path, scenario: str, *arguments: str) -> Result:
    """Run it in processes, then its effective configuration in this one; both must agree in every tick."""
    ended, summary = run_to_summary(out, scenario, *arguments)
    assert ended.code == 0, ended.out + ended.err
    theirs, ours = Record.load(out), simulate(read(out / CONFIG))
    assert ours.summary.ended == "complete"
    assert ours.summary.command_digest == summary.command_digest
    assert ours.summary.path_distance_m == summary.path_distance_m
    for name in ("angle_rad", "torque_nm", "target", "position_w", "contact_peak_n"):
        assert np.array_equal(getattr(ours.record, name), getattr(theirs, name), equal_nan=True), name
    # How often tick 0 is shown until the arming is chance, and whether the last one still comes while the host ends.
    for name in ("control", "worlds"):
        mine, other = ([told for told in getattr(record, name) if told.tick] for record in (ours.record, theirs))
        assert mine[: len(other)] == other and len(mine) - len(other) in (0, 1), name
    return ours


def test_processes_and_one_process_drive_the_motors_alike(tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", "clutter", "--duration", "1")


@pytest.mark.slow
@pytest.mark.parametrize("scenario", shipped("scenarios"))
def test_so_they_do_in_every_shipped_scenario(scenario: str, tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", scenario)


def test_so_do_joint_modules_behind_their_bus(tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", "triplet", "--duration", "1", "--backend", "can")


def test_faults_on_request_are_the_same_too(tmp_path: Path) -> None:
    faults = ["--fault", "wrong:joint_3@0.3-0.5=0.01", "--fault", "duplicate:guidance/world@0.2-0.6"]
    result = same_both_ways(tmp_path / "run", "triplet", "--duration", "1", *faults)
    assert any("wrong:joint_3" in text for text in result.record.host.injected)
