"""A report is opened in a real browser: its scripts run without an error, and every chart is drawn."""

from pathlib import Path

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.operator.browser import BROWSER_MISSING, CHROMIUM, open_chromium
from snakesim_testing.operator.triplet_report import (
    ReportReader,
    render_and_check_report,
    simulate_triplet,
)

COUNT_DRAWN_CHARTS = "document.querySelectorAll('.chart .main-svg .xaxislayer-above').length"
MEASURE_OVERFLOW_PX = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return simulate_triplet()


@pytest.mark.heavy
@pytest.mark.skipif(CHROMIUM is None, reason=BROWSER_MISSING)
@pytest.mark.parametrize("width", [1400, 400])
def test_report_in_browser_draws_every_chart_without_errors(
    record: RunRecord, tmp_path: Path, width: int
) -> None:
    reader: ReportReader = render_and_check_report(record)
    page = tmp_path / "report.html"
    page.write_text(reader.html)
    with open_chromium() as browser:
        tab = browser.open_page(page.as_uri(), width)
        tab.wait_until_loaded()
        assert tab.errors == []
        assert tab.evaluate(COUNT_DRAWN_CHARTS) == len(reader.charts) > 3
        assert tab.evaluate(MEASURE_OVERFLOW_PX) == 0
