"""A report in a real browser: its scripts run without an error, and every chart is drawn."""

from pathlib import Path

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.operator.browser import CHROMIUM, MISSING, open_chromium
from snakesim_testing.operator.recorded_triplet import ReportReader, read, triplet

DRAWN = "document.querySelectorAll('.chart .main-svg .xaxislayer-above').length"
OVERFLOW_PX = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return triplet()


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
@pytest.mark.parametrize("width", [1400, 400])
def test_every_chart_of_a_report_is_drawn_without_errors(
    record: RunRecord, tmp_path: Path, width: int
) -> None:
    reader: ReportReader = read(record)
    page = tmp_path / "report.html"
    page.write_text(reader.html)
    with open_chromium() as browser:
        tab = browser.open(page.as_uri(), width)
        tab.wait_until_loaded()
        assert tab.errors == []
        assert tab.value(DRAWN) == len(reader.charts) > 3
        assert tab.value(OVERFLOW_PX) == 0
