"""Tests of the comparison with `mujoco.sysid`: its tables, its results on one robot, and a missing package."""

import subprocess
import sys
from pathlib import Path

import pytest

from verification.sysid.__main__ import BAD_INPUT
from verification.sysid.comparison import (
    OURS,
    OURS_WITHOUT_IMUS,
    THEIRS,
    RobotComparison,
    append_result,
    compare_robot,
    read_results,
)
from verification.sysid.estimates import PARAMETERS, Estimate, IdentificationResult
from verification.sysid.rollout_fit import has_mujoco_sysid
from verification.sysid.tables import (
    is_any_joint,
    is_intact,
    is_loose,
    make_error_table,
    make_interval_table,
    make_report,
    make_value_table,
    make_verdict_table,
)

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(has_mujoco_sysid(), reason="mujoco.sysid is installed")
def test_missing_packages_are_named_with_the_way_out() -> None:
    command = [sys.executable, "-m", "verification.sysid", "--robots", "1"]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert completed.returncode == BAD_INPUT
    assert 'pip install "mujoco-core[sysid]"' in completed.stderr
    assert not completed.stdout


def make_identified(
    errors: dict[int, float | None], *, suspect: int | None
) -> IdentificationResult:
    """Return a result with one estimate a joint, given by its relative error. Its interval is 5 % to either side."""
    estimates = [
        Estimate(joint, "friction_nm", None if error is None else 2.0 * (1 + error), 0.1, 2.0)
        for joint, error in errors.items()
    ]
    return IdentificationResult(
        estimates, 1.0, warns=suspect is not None, suspect=suspect, noise_ratio=1.0
    )


def make_robot_with_backlash() -> RobotComparison:
    """Return a robot with backlash in joint 1: one method names it, one does not notice, one names another joint."""
    return RobotComparison(
        7,
        1,
        {
            OURS: make_identified({0: 0.02, 1: None}, suspect=1),
            OURS_WITHOUT_IMUS: make_identified({0: 0.06, 1: 0.2}, suspect=None),
            THEIRS: make_identified({0: 0.01, 1: 0.3}, suspect=0),
        },
    )


def find_cells(lines: list[str], first_cell: str) -> list[str]:
    """Return the cells of a row after its first one."""
    (row,) = [line for line in lines if line.startswith(f"| {first_cell} |")]
    return [cell.strip() for cell in row.split("|")[2:-1]]


def test_tables_count_errors_intervals_and_warnings() -> None:
    robots = [make_robot_with_backlash()]
    errors = list(make_error_table(robots, is_intact))
    ours = ["0", "2.00 %", "2.0 %"]
    theirs = ["1.00 %", "1.0 %"]
    assert find_cells(errors, "`friction_nm`") == ["1", *ours, *theirs, "1 of 1"]
    intervals = list(make_interval_table(robots, is_loose))
    assert find_cells(intervals, "`friction_nm`") == ["-", "-", "0 of 1 (0 to 79 %)", "5.0 %"]
    verdicts = list(make_verdict_table(robots))
    assert find_cells(verdicts, OURS) == ["1", "1", "1", "0"]
    assert find_cells(verdicts, OURS_WITHOUT_IMUS) == ["1", "0", "0", "0"]
    assert find_cells(verdicts, THEIRS) == ["1", "1", "0", "1"]
    values = list(make_value_table(robots, {"all": is_any_joint}))
    assert find_cells(values, OURS) == ["all", "1 of 2", "0", "0"]
    assert find_cells(values, OURS_WITHOUT_IMUS) == ["all", "2 of 2", "1", "1"]
    assert find_cells(values, THEIRS) == ["all", "2 of 2", "1", "1"]


def test_results_survive_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    assert read_results(path) == []
    robot = make_robot_with_backlash()
    endless = Estimate(0, "latency_s", 0.01, float("inf"), 0.02)
    other = RobotComparison(8, None, {THEIRS: IdentificationResult([endless], 2.0, warns=False)})
    append_result(path, robot)
    append_result(path, other)
    assert read_results(path) == [robot, other]


@pytest.mark.slow
@pytest.mark.skipif(not has_mujoco_sysid(), reason="mujoco.sysid is not installed")
def test_all_methods_find_the_parameters_of_a_robot() -> None:
    robot = compare_robot(3000, (), backlash=False)
    for result in robot.by_method.values():
        errors = [estimate.error for estimate in result.estimates if estimate.error is not None]
        assert len(errors) == 3 * len(PARAMETERS)
        assert max(errors) < 0.3
        assert not result.warns
    lines = list(make_report([robot]))
    assert sum(line.startswith("| `") for line in lines) == 2 * len(PARAMETERS)


@pytest.mark.slow
@pytest.mark.skipif(not has_mujoco_sysid(), reason="mujoco.sysid is not installed")
def test_all_methods_notice_backlash_and_imus_show_the_joint() -> None:
    robot = compare_robot(3000, (), backlash=True)
    assert all(result.warns for result in robot.by_method.values())
    ours = robot.by_method[OURS]
    assert ours.suspect == robot.loose
    assert not any(estimate.misleads for estimate in ours.estimates)
