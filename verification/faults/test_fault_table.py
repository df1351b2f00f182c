"""The harness of the fault table measures, judges, and writes: two cheap rows, and a row that is not met."""

from pathlib import Path

import pytest

from verification.faults.__main__ import main
from verification.faults.page import PAGE, TABLE_NAME, write
from verification.faults.results import FaultResults
from verification.faults.row import DRIVE_TYPES, FaultRow, InjectionTrial, RowResult, judge
from verification.faults.table import HEADINGS, ROWS


def test_fault_table_has_every_row_on_both_backends() -> None:
    assert len(ROWS) == sum(len(heading.rows) for heading in HEADINGS)
    for row in ROWS.values():
        assert set(row.measures) in ({"sim", "can"}, {"both"}, set(DRIVE_TYPES)), row.name
        assert any(not isinstance(measure, str) for measure in row.measures.values()), row.name


def test_fault_table_page_is_short_and_matches_raw_results(tmp_path: Path) -> None:
    page = write(FaultResults(), tmp_path / "faults.md").read_text()
    assert page == PAGE.read_text() and len(page.replace("|", "").split()) <= 800
    assert (tmp_path / TABLE_NAME).read_text() == PAGE.with_name(TABLE_NAME).read_text()


@pytest.mark.e2e
@pytest.mark.slow
def test_rows_are_measured_merged_and_written(tmp_path: Path) -> None:
    raw = tmp_path / "faults.json"
    options = ["--trials", "2", "--json", str(raw)]
    assert main(["--rows", "host_silent", *options]) == 0
    assert main(["--rows", "bus_duplicate_at_start", *options]) == 0
    results = FaultResults(raw).read()
    assert sorted(results) == [("bus_duplicate_at_start", "can"), ("host_silent", "can")]
    silent = results["host_silent", "can"]
    assert [trial.value for trial in silent.trials] == pytest.approx([100.0, 100.0], abs=1.0)
    page = write(FaultResults(raw), tmp_path / "faults.md").read_text()
    table = (tmp_path / "fault-table.csv").read_text()
    assert "**2 of " in page and "not run" in table and "not applicable: " in table
    for heading in HEADINGS:
        assert f"| {heading.fault} |" in page


def test_fault_table_row_is_judged_by_its_worst_trial() -> None:
    row = FaultRow(
        name="r", fault="fault", expected="stop", deadline="50 ms", limit=50.0, unit="ms",
        measures={"sim": lambda _request: iter(())},
    )  # fmt: skip

    def judged(*trials: InjectionTrial, broken: str = "") -> tuple[bool, str]:
        result = RowResult(
            row="r", backend="sim", when="2026-01-01 00:00", took_s=1.0, load=0.0, machine="", trials=list(trials),
            broken=broken,
        )  # fmt: skip
        verdict = judge(row, result)
        return verdict.met, verdict.reason

    good, late = InjectionTrial(value=40.0, recovered=True), InjectionTrial(value=50.1)
    assert judged(good, good) == (True, "")
    assert judged(good, late) == (False, "1 of 2 trials over 50 ms")
    assert judged(good, InjectionTrial(value=50.1, late_ms=0.2)) == (True, "")
    assert judged(good, InjectionTrial(value=50.3, late_ms=0.2))[0] is False
    assert judged(good, InjectionTrial(value=None)) == (False, "nothing measured in 1 of 2 trials")
    assert "no recovery" in judged(InjectionTrial(value=1.0, recovered=False))[1]
    assert "odd" in judged(good, InjectionTrial(value=1.0, failure="odd"))[1]
    assert judged(good, broken="it broke")[0] is False and judged()[0] is False
