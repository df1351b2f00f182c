"""Tests of the fault table: two quick rows are measured, judged and written, and rows that are not met are found."""

from pathlib import Path

import pytest

from verification.faults.__main__ import main
from verification.faults.page import PAGE, TABLE_NAME, write_page
from verification.faults.results import FaultResults
from verification.faults.row import (
    DRIVE_TYPES,
    FaultRow,
    InjectionTrial,
    RowResult,
    RowVerdict,
    judge_row,
)
from verification.faults.table import HEADINGS, ROWS


def test_fault_table_has_every_row_on_its_backends() -> None:
    assert len(ROWS) == sum(len(heading.rows) for heading in HEADINGS)
    for row in ROWS.values():
        assert set(row.measures) in ({"sim", "can"}, {"both"}, set(DRIVE_TYPES)), row.name
        assert any(not isinstance(measure, str) for measure in row.measures.values()), row.name


def test_fault_table_page_is_short_and_matches_raw_results(tmp_path: Path) -> None:
    page = write_page(FaultResults(), tmp_path / "faults.md").read_text()
    assert page == PAGE.read_text()
    assert len(page.replace("|", "").split()) <= 800
    assert (tmp_path / TABLE_NAME).read_text() == PAGE.with_name(TABLE_NAME).read_text()


@pytest.mark.e2e
@pytest.mark.slow
def test_measured_rows_are_merged_and_written(tmp_path: Path) -> None:
    raw = tmp_path / "faults.json"
    options = ["--trials", "2", "--json", str(raw)]
    assert main(["--rows", "host_silent", *options]) == 0
    assert main(["--rows", "bus_duplicate_at_start", *options]) == 0

    results = FaultResults(raw).read()
    assert sorted(results) == [("bus_duplicate_at_start", "can"), ("host_silent", "can")]
    delays_ms = [trial.value for trial in results["host_silent", "can"].trials]
    assert delays_ms == pytest.approx([100.0, 100.0], abs=1.0)

    page = write_page(FaultResults(raw), tmp_path / "faults.md").read_text()
    assert "**2 of " in page
    for heading in HEADINGS:
        assert f"| {heading.fault} |" in page
    table = (tmp_path / TABLE_NAME).read_text()
    assert "not run" in table
    assert "not applicable: " in table


def test_row_with_late_trial_is_not_met() -> None:
    in_time = InjectionTrial(value=40.0, recovered=True)
    late = InjectionTrial(value=50.1)
    assert _judge_trials(in_time, in_time).met
    assert _judge_trials(in_time, in_time).reason == ""
    assert not _judge_trials(in_time, late).met
    assert _judge_trials(in_time, late).reason == "1 of 2 trials over 50 ms"


def test_row_delayed_by_busy_computer_is_met() -> None:
    in_time = InjectionTrial(value=40.0, recovered=True)
    delayed = _judge_trials(in_time, InjectionTrial(value=50.1, late_ms=0.2))
    assert delayed.met
    assert delayed.reason == ""
    assert not _judge_trials(in_time, InjectionTrial(value=50.3, late_ms=0.2)).met


def test_row_with_failed_trial_is_not_met() -> None:
    in_time = InjectionTrial(value=40.0, recovered=True)
    without_value = _judge_trials(in_time, InjectionTrial(value=None))
    assert not without_value.met
    assert without_value.reason == "nothing measured in 1 of 2 trials"
    assert "no recovery" in _judge_trials(InjectionTrial(value=1.0, recovered=False)).reason
    assert "odd" in _judge_trials(in_time, InjectionTrial(value=1.0, failure="odd")).reason


def test_row_with_error_or_without_trial_is_not_met() -> None:
    in_time = InjectionTrial(value=40.0, recovered=True)
    assert not _judge_trials(in_time, broken="it broke").met
    assert not _judge_trials().met


def _judge_trials(*trials: InjectionTrial, broken: str = "") -> RowVerdict:
    """Judge trials of a row whose limit is 50 ms."""
    row = FaultRow(
        name="r",
        fault="fault",
        expected="stop",
        deadline="50 ms",
        limit=50.0,
        unit="ms",
        measures={"sim": lambda _request: iter(())},
    )
    result = RowResult(
        row="r",
        backend="sim",
        when="2026-01-01 00:00",
        took_s=1.0,
        load=0.0,
        machine="",
        trials=list(trials),
        broken=broken,
    )
    return judge_row(row, result)
