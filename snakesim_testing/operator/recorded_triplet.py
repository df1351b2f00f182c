"""A run of the triplet scenario for all tests of results, and a reader of the pages made of it."""

import dataclasses
import json
import re
from functools import cache
from html.parser import HTMLParser
from typing import Any

import msgspec
import numpy as np

from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_operator.results.page.html import LIBRARY
from snakesim_operator.results.report import render_report as report_page
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.in_process import simulate

PLOTLY = LIBRARY.read_text(encoding="utf-8")
RATE_HZ, SECONDS = 100.0, 10.0
LOST = "2 usable push-points, 3 are needed"  # how its locomotion ends
SECTIONS = ["playback", "overview", "snapshots", "joints", "loads", "numbers", "again"]
SVG_NAMESPACE = "http://www.w3.org/2000/svg"
ARMED_S = 0.37  # a robot is armed some time after its clock has begun


@cache
def triplet() -> RunRecord:
    """As shipped, 10 s; armed later, and with commands that were refused or limited."""
    record = simulate(load_scenario("triplet").config).record
    later_ns = round(ARMED_S * 1e9)
    reported = {
        name: [
            msgspec.structs.replace(one, timestamp_ns=one.timestamp_ns + later_ns)
            for one in getattr(record, name)
        ]
        for name in ("control_states", "worlds")
    }
    return dataclasses.replace(
        record, host=finished(1000), time_s=record.time_s + ARMED_S, **reported
    )


def first_seconds(record: RunRecord, seconds: float) -> RunRecord:
    """Return the beginning of a run, whose page takes less time to make."""
    count = round(seconds * RATE_HZ)
    end_ns = round((ARMED_S + seconds) * 1e9)
    columns = {
        field.name: getattr(record, field.name)[:count]
        for field in dataclasses.fields(record)
        if isinstance(getattr(record, field.name), np.ndarray)
    }
    messages = {
        name: [one for one in getattr(record, name) if one.timestamp_ns < end_ns]
        for name in ("control_states", "worlds")
    }
    return dataclasses.replace(record, host=finished(count), **columns, **messages)


def finished(ticks: int) -> HostRecord:
    """What the host of a complete run leaves."""
    return HostRecord(
        ticks=ticks,
        wall_s=2.5,
        overruns=0,
        answered_ticks=ticks - 1,
        armed_ticks=ticks,
        command_digest="0123456789abcdef" * 4,
        state_to_command_us={"p50": 310.0, "p99": 905.5},
        rejected_commands={"stale": 2},
        limited_commands={"torque_rate": 41, "max_step": 7},
        faults=[],
        lifecycle="disarmed",
        reason="finished",
    )


class ReportReader(HTMLParser):
    """Collects what the tests ask for, and refuses tags that do not match."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.html = page
        self.ids: list[str] = []
        self.words: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.titles: list[str] = []  # of drawings and charts
        self.charts: dict[str, Any] = {}
        self.film: dict[str, Any] = {}
        self._open: list[str] = []
        self.feed(page.replace(PLOTLY, ""))
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "br", "link", "input"):
            self._open.append(tag)
        self._note(tag, attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._note(tag, attrs)

    def _note(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.attributes += [(tag, name, value) for name, value in attrs]
        if given.get("id"):
            self.ids.append(str(given["id"]))
        if tag in ("svg", "figure") and given.get("aria-label"):
            self.titles.append(str(given["aria-label"]))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open[-1:] == ["script"] and data.startswith("{"):
            reported = json.loads(data)
            if "frames" in reported:
                self.film = reported
            else:
                self.charts[reported["label"]] = reported
        elif not {"style", "script", "pre"} & set(self._open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def read(record: RunRecord, ended: str = "complete") -> ReportReader:
    page = report_page(record, summarize_run(record, ended))
    reader = ReportReader(page)
    assert [i for i in reader.ids if i in SECTIONS] == SECTIONS
    assert len(page.encode()) < 3_000_000
    assert not [
        a for a in reader.attributes if a[2] is not None and re.search(r"\b(nan|inf|None)\b", a[2])
    ]
    assert not re.search(r"\b(None|nan|inf)\b", reader.text)
    assert not [a for a in reader.attributes if a[1] in ("src", "href")]
    ours = page.replace(PLOTLY, "")
    assert len(ours) < len(page)
    assert not re.search(r"@import|url\(|https?://", ours.replace(SVG_NAMESPACE, ""))
    return reader


def changed(record: RunRecord, **fields: Any) -> RunRecord:
    return dataclasses.replace(record, **fields)
