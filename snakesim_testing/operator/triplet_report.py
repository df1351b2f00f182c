"""Simulates the triplet scenario once for all tests of results, and reads the report of a run.

`ReportReader` parses a report. `render_and_check_report` also checks what every report must fulfill: it has all
sections in order, loads nothing from the network, and shows no missing number.
"""

import dataclasses
import json
import re
from functools import cache
from html.parser import HTMLParser
from typing import Any, TypeVar

import msgspec
import numpy as np

from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import ControlState, WorldModel
from snakesim_operator.results.page.html import LIBRARY
from snakesim_operator.results.report import render_report
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.in_process import simulate

PLOTLY = LIBRARY.read_text(encoding="utf-8")
RATE_HZ = 100.0
DURATION_S = 10.0
LOST_CONTACTS_REASON = "2 usable push-points, 3 are needed"  # ends the locomotion of the triplet
SECTIONS = ["playback", "overview", "snapshots", "joints", "loads", "numbers", "again"]
SVG_NAMESPACE = "http://www.w3.org/2000/svg"
ARMED_S = 0.37  # a real robot is armed some time after its clock has started
MAX_REPORT_BYTES = 3_000_000
VOID_TAGS = ("meta", "br", "link", "input")  # HTML tags that have no end tag


@cache
def simulate_triplet() -> RunRecord:
    """Simulate the shipped triplet scenario for 10 s.

    The record is changed so that the robot was armed at ARMED_S, and so that the host rejected and limited commands.
    """
    record = simulate(load_scenario("triplet").config).record
    delay_ns = round(ARMED_S * 1e9)
    return dataclasses.replace(
        record,
        host=make_finished_host_record(1000),
        time_s=record.time_s + ARMED_S,
        control_states=[_delay_message(state, delay_ns) for state in record.control_states],
        worlds=[_delay_message(world, delay_ns) for world in record.worlds],
    )


MessageT = TypeVar("MessageT", ControlState, WorldModel)


def _delay_message(message: MessageT, delay_ns: int) -> MessageT:
    return msgspec.structs.replace(message, timestamp_ns=message.timestamp_ns + delay_ns)


def cut_to_first_seconds(record: RunRecord, duration_s: float) -> RunRecord:
    """Return the first seconds of a run, whose report is rendered faster than that of the whole run."""
    count = round(duration_s * RATE_HZ)
    end_ns = round((ARMED_S + duration_s) * 1e9)
    columns = {
        field.name: getattr(record, field.name)[:count]
        for field in dataclasses.fields(record)
        if isinstance(getattr(record, field.name), np.ndarray)
    }
    messages = {
        name: [message for message in getattr(record, name) if message.timestamp_ns < end_ns]
        for name in ("control_states", "worlds")
    }
    return dataclasses.replace(record, host=make_finished_host_record(count), **columns, **messages)


def make_finished_host_record(ticks: int) -> HostRecord:
    """Return what the HAL host records about a run that has finished after so many ticks."""
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
    """Parses a report, collects what the tests check, and asserts that start tags and end tags match."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.html = page
        self.ids: list[str] = []
        self.text_parts: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []  # tag, name and value
        self.titles: list[str] = []  # of drawings and charts
        self.charts: dict[str, Any] = {}  # by their labels
        self.film: dict[str, Any] = {}
        self._open_tags: list[str] = []
        self.feed(page.replace(PLOTLY, ""))
        self.close()
        assert self._open_tags == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID_TAGS:
            self._open_tags.append(tag)
        self._collect_attributes(tag, attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._collect_attributes(tag, attrs)

    def _collect_attributes(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value) for name, value in attrs]
        value_by_name = dict(attrs)
        if value_by_name.get("id"):
            self.ids.append(str(value_by_name["id"]))
        if tag in ("svg", "figure") and value_by_name.get("aria-label"):
            self.titles.append(str(value_by_name["aria-label"]))

    def handle_endtag(self, tag: str) -> None:
        assert self._open_tags.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open_tags[-1:] == ["script"] and data.startswith("{"):
            self._collect_script_data(json.loads(data))
        elif not {"style", "script", "pre"} & set(self._open_tags):
            self.text_parts.append(data)

    def _collect_script_data(self, data: dict[str, Any]) -> None:
        """Keep the data of the playback, which has frames, or the data of a chart, which has a label."""
        if "frames" in data:
            self.film = data
        else:
            self.charts[data["label"]] = data

    @property
    def text(self) -> str:
        """The text of the page, with single spaces between words."""
        return " ".join(" ".join(self.text_parts).split())


def render_and_check_report(record: RunRecord, status: str = "complete") -> ReportReader:
    """Render the report of a run, assert what holds for every report, and return the parsed report.

    Args:
        record: The run.
        status: How the run ended.
    """
    page = render_report(record, summarize_run(record, status))
    reader = ReportReader(page)
    assert [i for i in reader.ids if i in SECTIONS] == SECTIONS
    assert len(page.encode()) < MAX_REPORT_BYTES
    assert not [
        attribute
        for attribute in reader.attributes
        if attribute[2] is not None and re.search(r"\b(nan|inf|None)\b", attribute[2])
    ]
    assert not re.search(r"\b(None|nan|inf)\b", reader.text)
    assert not [attribute for attribute in reader.attributes if attribute[1] in ("src", "href")]
    page_without_plotly = page.replace(PLOTLY, "")
    assert len(page_without_plotly) < len(page)
    own_text = page_without_plotly.replace(SVG_NAMESPACE, "")
    assert not re.search(r"@import|url\(|https?://", own_text)
    return reader


def replace_fields(record: RunRecord, **fields: Any) -> RunRecord:
    """Return a copy of a run record with other values in some fields."""
    return dataclasses.replace(record, **fields)
