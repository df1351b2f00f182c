"""Signals of a recording in the console, as people use them: searched, put beside each other, pointed at, saved."""

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

READABLE_PX = 9.0  # height of a text


def searched(tab: BrowserTab, words: str, then: str) -> None:
    """Type a search, and press what has this label."""
    tab.evaluate(
        f"(() => {{ const field = document.getElementById('search'); field.value = {json.dumps(words)};"
        "field.dispatchEvent(new Event('input')); })()"
    )
    tab.click(then)


def cells(tab: BrowserTab) -> dict[str, list[str]]:
    """What the tables say of each signal."""
    rows = tab.evaluate(
        "[...document.querySelectorAll('tr')].map(row => [...row.cells].map(cell => cell.innerText.trim()))"
    )
    return {row[0].removeprefix("■\xa0"): row[1:5] for row in rows}


@pytest.mark.slow
def test_console_signals_can_be_searched_compared_inspected_and_saved(tmp_path: Path) -> None:
    simulate(load_scenario("triplet", [parse_set_option("duration_s=2")]).config, tmp_path / "run")
    record = RunRecord.load(tmp_path / "run")
    angle = record.angle_rad[:, 4]
    measured, wanted = "angle_rad.joint_5, rad", "control.reference_rad.joint_5, rad"
    with run_recording_console(str(tmp_path / "run"), 1.0) as address, open_chromium() as browser:
        tab = browser.open_page(f"{address.rstrip('/')}/signals", 800, 900)
        tab.wait_for(" signals")
        tab.send("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        searched(tab, "joint_5 angle", measured)
        tab.wait_for("at 1.00 s")  # where the console stands
        searched(tab, "reference joint_5", "beside")
        searched(tab, "bending joint_5", "beside")  # in another unit: on an axis of its own
        searched(tab, "velocity joint_5", "beside")
        tab.wait_for("have both axes: put velocity_rad_s.joint_5 into a plot of its own")
        searched(tab, "torque_nm.joint_6", "torque_nm.joint_6, N·m")
        wait_until(lambda: cells(tab).get(measured, ["–"])[0] != "–", "values")
        said = cells(tab)
        assert [float(value) for value in said[measured]] == pytest.approx(
            [angle[record.find_nearest_row(1.0)], angle.min(), angle.mean(), angle.max()],
            rel=1e-3,
            abs=1e-3,
        )
        assert said[wanted][0] != "–"

        point(tab, 0.25)  # in the first plot: the cursor of both follows
        wait_until(lambda: cells(tab)[measured] != said[measured], "another instant")
        cursors = tab.evaluate(
            "[...document.querySelectorAll('.cursor')].map(one => one.getBoundingClientRect().left)"
        )
        assert len(cursors) == 2
        assert cursors[0] == pytest.approx(cursors[1], abs=2)
        point(tab, 0.25, press=True)  # and the snake in the console is there
        wait_until(
            lambda: now_s(address) == pytest.approx(0.5, abs=0.05), "the time that was pressed"
        )

        tab.evaluate(
            "(() => { const [low, high] = document.querySelectorAll('.ranges input');"
            "low.value = '-1'; high.value = '1'; high.onchange(); })()"
        )
        wait_until(lambda: tab.evaluate(AXIS) == [-1, 1], "the range that was typed")
        for label, file in (
            ("Save CSV", "signals.csv"),
            ("Save SVG", "signals.svg"),
            ("Save PNG", "signals.png"),
        ):
            tab.click(label)
            wait_until(lambda file=file: (tmp_path / file).is_file(), file)
        assert not tab.errors, tab.errors
        with pytest.raises(HTTPError):  # as an image of another site would ask
            urlopen(f"{address.rstrip('/')}/signals/go?time_s=1")
        labels_of_the_report_are_read_on_a_phone(browser, record, tmp_path)
    with (tmp_path / "signals.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    column = [
        float(row["angle_rad.joint_5 [rad]"]) for row in rows if row["angle_rad.joint_5 [rad]"]
    ]
    assert np.array_equal(column, angle)
    drawing = ET.fromstring((tmp_path / "signals.svg").read_text(encoding="utf-8"))
    words = "".join(drawing.itertext())
    assert measured in words
    assert "torque_nm.joint_6, N·m" in words
    assert (tmp_path / "signals.png").read_bytes().startswith(b"\x89PNG")


def labels_of_the_report_are_read_on_a_phone(
    browser: ChromiumBrowser, record: RunRecord, folder: Path
) -> None:
    """Those of the scales in its drawings; a browser is there, and so is a run."""
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
    assert min(heights) >= READABLE_PX


AXIS = "document.querySelector('.plot').layout.yaxis.range"


def point(tab: BrowserTab, share: float, *, press: bool = False) -> None:
    """Move the pointer to a share of the time in the first plot."""
    at = tab.evaluate(
        "(() => { const plot = document.querySelector('.plot'), r = plot.getBoundingClientRect(),"
        f"s = plot._fullLayout._size; return [r.left + s.l + {share} * s.w, r.top + s.t + s.h / 2]; }})()"
    )
    for kind in ("mouseMoved", *(("mousePressed", "mouseReleased") if press else ())):
        button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
        tab.send("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **button)


def now_s(address: str) -> float:
    """The time that the console shows."""
    with urlopen(Request(f"{address.rstrip('/')}/signals/now"), timeout=10) as answer:
        return json.load(answer)["time_s"]
