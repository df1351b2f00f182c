"""The page: verdict, playback, advance, instants, joints, loads, numbers. A section with nothing to show says why."""

from pathlib import Path
from typing import Any, get_type_hints

import msgspec
from markupsafe import Markup
from msgspec import Meta

from snakesim_hal.wire.messages import TICK_TIMES
from snakesim_operator.results.metrics.propulsion import propulsion_intervals
from snakesim_operator.results.page.html import render
from snakesim_operator.results.record import CONFIG, RunRecord
from snakesim_operator.results.report import figures
from snakesim_operator.results.report.events import Event, drawn_instants, find_events, select_listed
from snakesim_operator.results.report.instants import measured_along_n
from snakesim_operator.results.report.playback import playback
from snakesim_operator.results.report.polygon import force_polygon, pretty, units_per_n
from snakesim_operator.results.report.pushing import pushing
from snakesim_operator.results.report.reasons import why_at_limit, why_empty, why_late, why_refused
from snakesim_operator.results.report.timeline import distance, in_words, joined, most_used_joints
from snakesim_operator.results.report.top_view import top_view
from snakesim_operator.results.report.verdict import verdict
from snakesim_operator.results.report.view import nodes_xy_w, views
from snakesim_operator.results.summary import RunSummary, distance_m
from snakesim_operator.results.time_axis import end_s, zero_s

HERE = Path(__file__).parent
VIEW_WIDTH = 500.0
TURNS_SHOWN = 100  # of one joint in a chart
POLYGON = (236.0, 226.0)
ELSEWHERE = ("config", "faults", "rejected_commands", "limited_commands", "tick_times")


def page(record: RunRecord, summary: RunSummary) -> str:
    """The whole page."""
    found = find_events(record, summary)
    every = propulsion_intervals(record)
    intervals = joined(every, end_s(record) / TURNS_SHOWN)
    return render(
        HERE / "report.html",
        len(record.description.joints),
        styles=[HERE / "figure.css"],
        scripts=[HERE / "playback.js"],
        title=record.config.title or summary.scenario,
        record=record,
        summary=summary,
        verdict=verdict(record, summary),
        pretty=pretty,
        in_words=in_words,
        film=playback(record),
        names=[joint.name for joint in record.description.joints],
        events=select_listed(found),
        instants=_instants(record, found),
        pushing=pushing(record),
        moved=distance(record) if len(record.time_s) else None,
        moved_m=distance_m(summary),
        why_empty=why_empty(record),
        why_at_limit=why_at_limit(record),
        why_late=why_late(summary),
        tick_times=TICK_TIMES,
        why_refused=why_refused(summary),
        limit_nm=max(joint.torque_limit_nm for joint in record.description.joints),
        intervals=intervals,
        joints=[(joint, [one for one in every if one.joint == joint]) for joint in most_used_joints(intervals)],
        propelled=len({one.joint for one in intervals}),
        figures=figures,
        begin_s=zero_s(record),
        first_kept=len(summary.faults) // 2,  # of a log that left some out, the first half are the first ones
        numbers=_numbers(summary),
        config_file=_config_file(record),
        config=msgspec.json.format(msgspec.json.encode(summary.config), indent=2).decode(),
    )


def playback_page(record: RunRecord, summary: RunSummary) -> str:
    """Verdict and playback alone, without charts: small enough for a notebook."""
    return render(
        HERE / "playback.html",
        len(record.description.joints),
        styles=[HERE / "figure.css"],
        scripts=[HERE / "playback.js"],
        charts=False,
        title=record.config.title or summary.scenario,
        verdict=verdict(record, summary),
        film=playback(record),
        events=select_listed(find_events(record, summary)),
        names=[joint.name for joint in record.description.joints],
    )


def _instants(record: RunRecord, found: list[Event]) -> list[dict[str, Any]]:
    """The drawings of each event, and what stands beside them."""
    chosen = drawn_instants(record, found)
    balances = [instant.balance for _, instant in chosen if instant.balance is not None]
    cards: list[dict[str, Any]] = []
    windows = views(record, [instant for _, instant in chosen], VIEW_WIDTH)
    for (event, instant), view in zip(chosen, windows, strict=True):
        nodes, polygon = nodes_xy_w(record, instant.row), None
        ahead = nodes[-1] - nodes[0]
        if instant.balance is not None:
            scale = units_per_n(balances, *POLYGON, upright=view.upright)
            polygon = Markup(force_polygon(instant.balance, instant.felt, *POLYGON, scale, upright=view.upright))
            ahead = instant.balance.resultant_n
        pushed_n = measured_along_n(instant, ahead)
        drawn = Markup(top_view(record, instant, view))
        cards.append({"event": event, "instant": instant, "view": drawn, "polygon": polygon, "pushed_n": pushed_n})
    return cards


def _numbers(summary: RunSummary) -> list[tuple[str, Any, str, str]]:
    """Every field with its unit and what it means, from the Struct itself."""
    hints = get_type_hints(RunSummary, include_extras=True)
    rows: list[tuple[str, Any, str, str]] = []
    for field in msgspec.structs.fields(RunSummary):
        if field.name in ELSEWHERE:
            continue
        notes = getattr(hints[field.name], "__metadata__", ())
        meta: Meta | None = next((note for note in notes if isinstance(note, Meta)), None)
        unit = ((meta.extra_json_schema or {}).get("unit", "") if meta else "").removeprefix("1")
        rows.append((field.name, getattr(summary, field.name), unit, (meta.description or "") if meta else ""))
    return rows


def _config_file(record: RunRecord) -> Path:
    """A recording alone has none beside it: its configuration stands on the page."""
    if record.alone:
        return Path(CONFIG)
    here = Path.cwd()
    folder = record.folder.relative_to(here) if record.folder.is_relative_to(here) else record.folder
    return folder / CONFIG
