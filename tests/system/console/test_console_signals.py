"""The signals page of the console searches, compares, inspects and saves signals of a recording, in a browser."""

import csv
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.report import render_report
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.in_process import simulate
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.browser import (
    BROWSER_MISSING,
    CHROMIUM,
    BrowserTab,
    ChromiumBrowser,
    open_chromium,
)
from verification.screenshots import run_recording_console

pytestmark = [pytest.mark.e2e, pytest.mark.skipif(CHROMIUM is None, reason=BROWSER_MISSING)]

MIN_TEXT_HEIGHT_PX = 9.0  # of a readable label


def search_and_click(tab: BrowserTab, query: str, label: str) -> None:
    """Type a query into the search field, and click the result or button with a label."""
    tab.evaluate(
        f"(() => {{ const field = document.getElementById('search'); field.value = {json.dumps(query)};"
        "field.dispatchEvent(new Event('input')); })()"
    )
    tab.click(label)


def read_signal_tables(tab: BrowserTab) -> dict[str, list[str]]:
    """Return the values in the tables of the page, by the name of the signal."""
    rows = tab.evaluate(
        "[...document.querySelectorAll('tr')].map(row => [...row.cells].map(cell => cell.innerText.trim()))"
    )
    return {row[0].removeprefix("■\xa0"): row[1:5] for row in rows}


@pytest.mark.slow
def test_console_signals_can_be_searched_compared_inspected_and_saved(tmp_path: Path) -> None:
    simulate(load_scenario("triplet", [parse_set_option("duration_s=2")]).config, tmp_path / "run")
    record = RunRecord.load(tmp_path / "run")
    angle = record.angle_rad[:, 4]
    measured = "angle_rad.joint_5, rad"
    reference = "control.reference_rad.joint_5, rad"
    with run_recording_console(str(tmp_path / "run"), 1.0) as address, open_chromium() as browser:
        tab = browser.open_page(f"{address.rstrip('/')}/signals", 800, 900)
        tab.wait_for(" signals")
        tab.send("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        search_and_click(tab, "joint_5 angle", measured)
        tab.wait_for("at 1.00 s")  # the time that the console shows
        search_and_click(tab, "reference joint_5", "beside")
        search_and_click(tab, "bending joint_5", "beside")  # has another unit and its own axis
        search_and_click(tab, "velocity joint_5", "beside")
        tab.wait_for("have both axes: put velocity_rad_s.joint_5 into a plot of its own")
        search_and_click(tab, "torque_nm.joint_6", "torque_nm.joint_6, N·m")
        wait_until(lambda: read_signal_tables(tab).get(measured, ["–"])[0] != "–", "values")
        values = read_signal_tables(tab)
        assert [float(value) for value in values[measured]] == pytest.approx(
            [angle[record.find_nearest_row(1.0)], angle.min(), angle.mean(), angle.max()],
            rel=1e-3,
            abs=1e-3,
        )
        assert values[reference][0] != "–"

        move_pointer(tab, 0.25)  # The cursors of both plots follow.
        wait_until(lambda: read_signal_tables(tab)[measured] != values[measured], "another instant")
        cursors = tab.evaluate(
            "[...document.querySelectorAll('.cursor')].map(cursor => cursor.getBoundingClientRect().left)"
        )
        assert len(cursors) == 2
        assert cursors[0] == pytest.approx(cursors[1], abs=2)
        move_pointer(tab, 0.25, press=True)  # The console shows the snake at that time.
        wait_until(
            lambda: read_shown_time_s(address) == pytest.approx(0.5, abs=0.05), "the selected time"
        )

        tab.evaluate(
            "(() => { const [low, high] = document.querySelectorAll('.ranges input');"
            "low.value = '-1'; high.value = '1'; high.onchange(); })()"
        )
        wait_until(lambda: tab.evaluate(AXIS_RANGE) == [-1, 1], "the entered range")
        for label, file in (
            ("Save CSV", "signals.csv"),
            ("Save SVG", "signals.svg"),
            ("Save PNG", "signals.png"),
        ):
            tab.click(label)
            wait_until(lambda file=file: (tmp_path / file).is_file(), file)
        assert not tab.errors, tab.errors
        # An image on another site could send such a request.
        with pytest.raises(HTTPError):
            urlopen(f"{address.rstrip('/')}/signals/go?time_s=1")
        check_report_labels_on_phone(browser, record, tmp_path)
    with (tmp_path / "signals.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    saved_angles = [
        float(row["angle_rad.joint_5 [rad]"]) for row in rows if row["angle_rad.joint_5 [rad]"]
    ]
    assert np.array_equal(saved_angles, angle)
    drawing = ET.fromstring((tmp_path / "signals.svg").read_text(encoding="utf-8"))
    texts = "".join(drawing.itertext())
    assert measured in texts
    assert "torque_nm.joint_6, N·m" in texts
    assert (tmp_path / "signals.png").read_bytes().startswith(b"\x89PNG")


def check_report_labels_on_phone(browser: ChromiumBrowser, record: RunRecord, folder: Path) -> None:
    """Check that the scale labels in the drawings of a report are large enough on a phone."""
    (folder / "report.html").write_text(
        render_report(record, summarize_run(record, "complete")), encoding="utf-8"
    )
    phone = browser.open_page((folder / "report.html").as_uri(), 400, 900)
    phone.set_window_size(400, 900, mobile=True)
    phone.wait_for("Playback")
    heights = phone.evaluate(
        "[...document.querySelectorAll('.figure text.small')]"
        ".filter(label => /^\\d+ (cm|m|N)$/.test(label.textContent)).map(label => label.getBoundingClientRect().height)"
    )
    assert len(heights) >= 2
    assert min(heights) >= MIN_TEXT_HEIGHT_PX


AXIS_RANGE = "document.querySelector('.plot').layout.yaxis.range"


def move_pointer(tab: BrowserTab, fraction: float, *, press: bool = False) -> None:
    """Move the pointer to a fraction of the time range in the first plot, and optionally press there."""
    x_px, y_px = tab.evaluate(
        "(() => { const plot = document.querySelector('.plot'), r = plot.getBoundingClientRect(),"
        f"s = plot._fullLayout._size; return [r.left + s.l + {fraction} * s.w, r.top + s.t + s.h / 2]; }})()"
    )
    tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x_px, y=y_px)
    if press:
        button = {"button": "left", "clickCount": 1}
        tab.send("Input.dispatchMouseEvent", type="mousePressed", x=x_px, y=y_px, **button)
        tab.send("Input.dispatchMouseEvent", type="mouseReleased", x=x_px, y=y_px, **button)


def read_shown_time_s(address: str) -> float:
    """Return the time of the recording that the console shows."""
    with urlopen(Request(f"{address.rstrip('/')}/signals/now"), timeout=10) as answer:
        return json.load(answer)["time_s"]
