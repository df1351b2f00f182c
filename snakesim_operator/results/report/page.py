"""Renders the report of a run. A section without content states the reason."""

from pathlib import Path
from typing import Any, get_type_hints

import msgspec
from markupsafe import Markup
from msgspec import Meta

from snakesim_hal.wire.messages import TICK_TIMES
from snakesim_operator.results.metrics.propulsion import (
    PropulsionInterval,
    find_propulsion_intervals,
)
from snakesim_operator.results.page.html import render_page
from snakesim_operator.results.report import figures
from snakesim_operator.results.report.events import (
    ReportEvent,
    find_events,
    select_listed_events,
    select_snapshots_to_draw,
)
from snakesim_operator.results.report.playback import make_playback
from snakesim_operator.results.report.polygon import (
    draw_force_polygon,
    find_common_force_scale,
    format_subscript,
)
from snakesim_operator.results.report.pushing import make_pushing_section
from snakesim_operator.results.report.reasons import (
    explain_late_commands,
    explain_push_points_without_contact,
    explain_refused_commands,
    explain_torque_limit,
)
from snakesim_operator.results.report.snapshots import project_measured_force_n
from snakesim_operator.results.report.timeline import (
    describe_state,
    find_most_propelling_joints,
    join_intervals,
    measure_distance,
)
from snakesim_operator.results.report.top_view import draw_top_view
from snakesim_operator.results.report.verdict import make_verdict
from snakesim_operator.results.report.view import compute_viewports, find_body_points_xy_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import CONFIG_FILENAME
from snakesim_operator.results.summary import RunSummary, get_distance_m
from snakesim_operator.results.time_axis import get_run_end_s, get_time_origin_s

HERE = Path(__file__).parent
VIEW_WIDTH = 500.0
MAX_INTERVALS_SHOWN = 100  # of one joint in a chart
POLYGON_SIZE = (236.0, 226.0)
ELSEWHERE = ("config", "faults", "rejected_commands", "limited_commands", "tick_times")
"""Fields of the summary that are not in the table of numbers, because another section has them."""


def render_report(record: RunRecord, summary: RunSummary) -> str:
    """Render the report of one run as an HTML page.

    Args:
        record: The recorded run.
        summary: Summary of the run.
    """
    events = find_events(record, summary)
    all_intervals = find_propulsion_intervals(record)
    shown_intervals = join_intervals(all_intervals, get_run_end_s(record) / MAX_INTERVALS_SHOWN)
    intervals_by_joint: list[tuple[int, list[PropulsionInterval]]] = []
    for joint in find_most_propelling_joints(shown_intervals):
        intervals_of_joint = [
            interval for interval in all_intervals if interval.joint_index == joint
        ]
        intervals_by_joint.append((joint, intervals_of_joint))
    propelling_joints = {interval.joint_index for interval in shown_intervals}
    config_json = msgspec.json.format(msgspec.json.encode(summary.config), indent=2).decode()
    return render_page(
        HERE / "report.html",
        len(record.description.joints),
        styles=[HERE / "figure.css"],
        scripts=[HERE / "playback.js"],
        # The run and its verdict.
        title=record.config.title or summary.scenario,
        record=record,
        summary=summary,
        verdict=make_verdict(record, summary),
        film=make_playback(record),
        # Sections and figures.
        events=select_listed_events(events),
        snapshots=_make_snapshot_cards(record, events),
        pushing=make_pushing_section(record),
        moved=measure_distance(record) if len(record.time_s) else None,
        moved_m=get_distance_m(summary),
        figures=figures,
        names=[joint.name for joint in record.description.joints],
        limit_nm=max(joint.torque_limit_nm for joint in record.description.joints),
        intervals=shown_intervals,
        joints=intervals_by_joint,
        propelled=len(propelling_joints),
        begin_s=get_time_origin_s(record),
        # Explanations of numbers that are not good.
        empty_reason=explain_push_points_without_contact(record),
        at_limit_reason=explain_torque_limit(record),
        late_reason=explain_late_commands(summary),
        refused_reason=explain_refused_commands(summary),
        # Lists and tables.
        tick_times=TICK_TIMES,
        first_faults=len(summary.faults)
        // 2,  # if faults are left out, the first half are the first ones of the run
        numbers=_list_summary_fields(summary),
        config_file=_find_config_path(record),
        config=config_json,
        # Functions for the template.
        pretty=format_subscript,
        in_words=describe_state,
    )


def render_playback_page(record: RunRecord, summary: RunSummary) -> str:
    """Render a page with only the verdict and the playback of a run, which is small enough for a notebook."""
    return render_page(
        HERE / "playback.html",
        len(record.description.joints),
        styles=[HERE / "figure.css"],
        scripts=[HERE / "playback.js"],
        charts=False,
        title=record.config.title or summary.scenario,
        verdict=make_verdict(record, summary),
        film=make_playback(record),
        events=select_listed_events(find_events(record, summary)),
        names=[joint.name for joint in record.description.joints],
    )


def _make_snapshot_cards(record: RunRecord, events: list[ReportEvent]) -> list[dict[str, Any]]:
    """Make the content of the snapshot cards of the report: for each drawn event its drawings as SVG, and numbers.

    Args:
        record: The recorded run.
        events: All events of the run; only some of them are drawn.

    Returns:
        A dictionary for each card, whose keys the template reads: `event`, `snapshot`, `view` (top view), `polygon`
        (force polygon; None if the snapshot has no balanced forces), and `pushed_n` (measured contact force in the
        direction of travel, in N).
    """
    drawn_events = select_snapshots_to_draw(record, events)
    snapshots = [snapshot for _, snapshot in drawn_events]
    viewports = compute_viewports(record, snapshots, VIEW_WIDTH)
    force_balances = [
        snapshot.force_balance for snapshot in snapshots if snapshot.force_balance is not None
    ]
    cards: list[dict[str, Any]] = []
    for (event, snapshot), viewport in zip(drawn_events, viewports, strict=True):
        force_balance = snapshot.force_balance
        if force_balance is None:
            body_points_w = find_body_points_xy_w(record, snapshot.row)
            forward_w = body_points_w[-1] - body_points_w[0]  # from the tail to the head
            polygon = None
        else:
            forward_w = force_balance.resultant_force_n
            scale = find_common_force_scale(
                force_balances, *POLYGON_SIZE, upright=viewport.is_rotated
            )
            drawing = draw_force_polygon(
                force_balance,
                snapshot.measured_contacts,
                *POLYGON_SIZE,
                scale,
                upright=viewport.is_rotated,
            )
            polygon = Markup(drawing)
        cards.append(
            {
                "event": event,
                "snapshot": snapshot,
                "view": Markup(draw_top_view(record, snapshot, viewport)),
                "polygon": polygon,
                "pushed_n": project_measured_force_n(snapshot, forward_w),
            }
        )
    return cards


def _list_summary_fields(summary: RunSummary) -> list[tuple[str, Any, str, str]]:
    """List name, value, unit and description of every field of the summary that the table of the report shows."""
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
    """Return the Meta object of an annotated type, or None if it has none."""
    for note in getattr(hint, "__metadata__", ()):
        if isinstance(note, Meta):
            return note
    return None


def _find_config_path(record: RunRecord) -> Path:
    """Return the path of the configuration as the report shows it, relative to the working folder if possible.

    If only a recording exists, this is the file name under which a user may save the configuration on the page.
    """
    config_path = record.config_path
    if config_path is None:
        return Path(CONFIG_FILENAME)
    working_folder = Path.cwd()
    if config_path.is_relative_to(working_folder):
        return config_path.relative_to(working_folder)
    return config_path
