"""The page: verdict, playback, advance, snapshots, joints, loads, numbers. An empty section gives the reason."""

from pathlib import Path
from typing import Any, get_type_hints

import msgspec
from markupsafe import Markup
from msgspec import Meta

from snakesim_hal.wire.messages import TICK_TIMES
from snakesim_operator.results.metrics.propulsion import Propulsion, find_propulsion_intervals
from snakesim_operator.results.page.html import render
from snakesim_operator.results.report import figures
from snakesim_operator.results.report.events import Event, drawn_snapshots, find_events, select_listed
from snakesim_operator.results.report.playback import playback
from snakesim_operator.results.report.polygon import common_scale, force_polygon, with_subscript
from snakesim_operator.results.report.pushing import pushing
from snakesim_operator.results.report.reasons import why_at_limit, why_empty, why_late, why_refused
from snakesim_operator.results.report.snapshots import measured_along_n
from snakesim_operator.results.report.timeline import distance, in_words, joined, most_used_joints
from snakesim_operator.results.report.top_view import top_view
from snakesim_operator.results.report.verdict import verdict
from snakesim_operator.results.report.view import nodes_xy_w, views
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import CONFIG
from snakesim_operator.results.summary import RunSummary, distance_m
from snakesim_operator.results.time_axis import end_s, zero_s

HERE = Path(__file__).parent
VIEW_WIDTH = 500.0
MAX_SPANS_SHOWN = 100  # of one joint in a chart
POLYGON_SIZE = (236.0, 226.0)
ELSEWHERE = ("config", "faults", "rejected_commands", "limited_commands", "tick_times")
"""Fields of the summary that are not in the table of numbers, because another section has them."""


def page(record: RunRecord, summary: RunSummary) -> str:
    """Return the report of one run as an HTML page.

    Args:
        record: The recorded run.
        summary: The numbers of the run.
    """
    events = find_events(record, summary)
    all_intervals = find_propulsion_intervals(record)
    shown_intervals = joined(all_intervals, end_s(record) / MAX_SPANS_SHOWN)
    intervals_by_joint: list[tuple[int, list[Propulsion]]] = []
    for joint in most_used_joints(shown_intervals):
        intervals_of_joint = [interval for interval in all_intervals if interval.joint == joint]
        intervals_by_joint.append((joint, intervals_of_joint))
    propelling_joints = {interval.joint for interval in shown_intervals}
    config_json = msgspec.json.format(msgspec.json.encode(summary.config), indent=2).decode()
    return render(
        HERE / "report.html",
        len(record.description.joints),
        styles=[HERE / "figure.css"],
        scripts=[HERE / "playback.js"],
        # The run and its verdict.
        title=record.config.title or summary.scenario,
        record=record,
        summary=summary,
        verdict=verdict(record, summary),
        film=playback(record),
        # Sections and figures.
        events=select_listed(events),
        snapshots=_describe_snapshots(record, events),
        pushing=pushing(record),
        moved=distance(record) if len(record.time_s) else None,
        moved_m=distance_m(summary),
        figures=figures,
        names=[joint.name for joint in record.description.joints],
        limit_nm=max(joint.torque_limit_nm for joint in record.description.joints),
        intervals=shown_intervals,
        joints=intervals_by_joint,
        propelled=len(propelling_joints),
        begin_s=zero_s(record),
        # Explanations of numbers that are not good.
        why_empty=why_empty(record),
        why_at_limit=why_at_limit(record),
        why_late=why_late(summary),
        why_refused=why_refused(summary),
        # Lists and tables.
        tick_times=TICK_TIMES,
        first_faults=len(summary.faults) // 2,  # of a log that left some out, the first half are the first ones
        numbers=_numbers(summary),
        config_file=_config_file(record),
        config=config_json,
        # Functions for the template.
        pretty=with_subscript,
        in_words=in_words,
    )


def playback_page(record: RunRecord, summary: RunSummary) -> str:
    """Return a page with verdict and playback alone, without charts: small enough for a notebook."""
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


def _describe_snapshots(record: RunRecord, events: list[Event]) -> list[dict[str, Any]]:
    """Return what the template shows for each event that is drawn: drawings as SVG, and numbers.

    Args:
        record: The recorded run.
        events: All events of the run; only some of them are drawn.

    Returns:
        A dictionary for each event: the event, its snapshot, the top view, the force polygon (None without balanced
        forces), and `pushed_n`, the measured contact force in the direction of travel.
    """
    chosen = drawn_snapshots(record, events)
    snapshots = [snapshot for _, snapshot in chosen]
    top_views = views(record, snapshots, VIEW_WIDTH)
    balances = [snapshot.balance for snapshot in snapshots if snapshot.balance is not None]
    cards: list[dict[str, Any]] = []
    for (event, snapshot), view in zip(chosen, top_views, strict=True):
        balance = snapshot.balance
        if balance is None:
            nodes = nodes_xy_w(record, snapshot.row)
            forward = nodes[-1] - nodes[0]  # from the tail to the head
            polygon = None
        else:
            forward = balance.resultant_n
            scale = common_scale(balances, *POLYGON_SIZE, upright=view.upright)
            drawing = force_polygon(balance, snapshot.measured_contacts, *POLYGON_SIZE, scale, upright=view.upright)
            polygon = Markup(drawing)
        cards.append(
            {
                "event": event,
                "snapshot": snapshot,
                "view": Markup(top_view(record, snapshot, view)),
                "polygon": polygon,
                "pushed_n": measured_along_n(snapshot, forward),
            }
        )
    return cards


def _numbers(summary: RunSummary) -> list[tuple[str, Any, str, str]]:
    """Return name, value, unit and description of every field that the page shows in its table."""
    hints = get_type_hints(RunSummary, include_extras=True)
    rows: list[tuple[str, Any, str, str]] = []
    for field in msgspec.structs.fields(RunSummary):
        if field.name in ELSEWHERE:
            continue
        unit = ""
        description = ""
        meta = _find_meta(hints[field.name])
        if meta is not None:
            unit = (meta.extra_json_schema or {}).get("unit", "").removeprefix("1")
            description = meta.description or ""
        rows.append((field.name, getattr(summary, field.name), unit, description))
    return rows


def _find_meta(hint: Any) -> Meta | None:
    for note in getattr(hint, "__metadata__", ()):
        if isinstance(note, Meta):
            return note
    return None


def _config_file(record: RunRecord) -> Path:
    """Return the path of the configuration, as the page names it.

    A recording alone has no such file beside it: its configuration is on the page.
    """
    path = record.config_path
    if path is None:
        return Path(CONFIG)
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
