"""The page: verdict, playback, instants, advance, joints, loads, numbers. A section with nothing to show says why."""

from pathlib import Path
from typing import Any, get_type_hints

import msgspec
import numpy as np
from markupsafe import Markup
from msgspec import Meta

from snakesim_hal.safety.fault_log import FIRST_KEPT
from snakesim_operator.results.page.html import data, render, shown
from snakesim_operator.results.record import CONFIG, RunRecord
from snakesim_operator.results.report import figures
from snakesim_operator.results.report.events import Event, drawn_instants, events
from snakesim_operator.results.report.instants import Balance, Instant, felt_along_n
from snakesim_operator.results.report.playback import playback
from snakesim_operator.results.report.polygon import force_polygon, pretty, units_per_n
from snakesim_operator.results.report.svg import arrow
from snakesim_operator.results.report.timeline import (
    Propulsion,
    distance,
    in_words,
    most_used_joints,
    propulsion_intervals,
)
from snakesim_operator.results.report.top_view import top_view
from snakesim_operator.results.report.verdict import tiles, verdict
from snakesim_operator.results.report.view import nodes_xy_w, views
from snakesim_operator.results.summary import RunSummary

HERE = Path(__file__).parent
FIGURE_STYLE = HERE / "figure.css"
VIEW_WIDTH = 500.0
POLYGON = (236.0, 226.0)
ELSEWHERE = ("config", "faults", "rejected_commands", "limited_commands")
EVENTS_SHOWN = 14


def page(record: RunRecord, summary: RunSummary) -> str:
    """The whole page."""
    intervals = propulsion_intervals(record)
    found = events(record, summary)
    moved = distance(record) if len(record.time_s) else None
    film = playback(record)
    instants = _instants(record, drawn_instants(record, found))
    return render(
        HERE / "report.html",
        len(record.description.joints),
        styles=[FIGURE_STYLE],
        scripts=[HERE / "playback.js"],
        title=record.config.title or summary.scenario,
        record=record,
        summary=summary,
        verdict=verdict(record, summary),
        tiles=tiles(record, summary),
        swatch=_swatch,
        film=film,
        film_picture=Markup(film.picture) if film else None,
        film_data=data(film.data) if film else None,
        events=found if len(found) <= EVENTS_SHOWN else [*found[: EVENTS_SHOWN - 2], *found[-2:]],
        instants=instants,
        no_forces=None if any(one["polygon"] for one in instants) else _why_no_polygon(record, summary),
        moved=moved,
        intervals=intervals,
        advance=figures.advance(record, moved) if moved else None,
        happened=figures.what_happened(record, intervals) if record.control or intervals else None,
        joints=_joints(record, intervals),
        propelled=len({one.joint for one in intervals}),
        **(_loads(record, intervals) if len(record.time_s) else {}),
        fault_rows=_faults(record, summary),
        numbers=_numbers(summary),
        command=_command(record, summary),
        config=msgspec.json.format(msgspec.json.encode(summary.config), indent=2).decode(),
    )


def _instants(record: RunRecord, chosen: list[tuple[Event, Instant]]) -> list[dict[str, Any]]:
    drawn = [instant for _, instant in chosen]
    windows = views(record, drawn, VIEW_WIDTH)
    balances = [one.balance for one in drawn if one.balance is not None]
    cards: list[dict[str, Any]] = []
    for (event, instant), view in zip(chosen, windows, strict=True):
        polygon = None
        if instant.balance is not None:
            scale = units_per_n(balances, *POLYGON, upright=view.upright)
            polygon = Markup(force_polygon(instant.balance, *POLYGON, scale, upright=view.upright))
        joint = instant.propulsion_joint
        cards.append(
            {
                "event": event.words,
                "time_s": instant.time_s,
                "joint": joint,
                "name": record.description.joints[joint].name if joint is not None else None,
                "state": instant.state,
                "told": in_words(instant.state.state) if instant.state is not None else None,
                "view": Markup(top_view(record, instant, view)),
                "polygon": polygon,
                "forces": _forces(instant, instant.balance) if instant.balance is not None else [],
                "facts": _facts(instant, instant.balance) if instant.balance is not None else [],
                "touches": len(instant.felt),
                "pushed_n": _pushed_n(record, instant),
            }
        )
    return cards


def _pushed_n(record: RunRecord, instant: Instant) -> float:
    nodes = nodes_xy_w(record, instant)
    return felt_along_n(instant, nodes[-1] - nodes[0])


def _forces(instant: Instant, balance: Balance) -> list[tuple[str, str, str, str]]:
    """Solved against measured at each push-point."""
    rows: list[tuple[str, str, str, str]] = []
    for i, (contact, size) in enumerate(zip(balance.contacts, balance.size_n, strict=True)):
        felt = [np.hypot(*c.force_w[:2]) for c in instant.felt if c.obstacle == contact.obstacle]
        measured = f"{sum(felt):.0f} N" if felt else "–"
        rows.append((pretty(f"f_{i + 1}"), f"{size:.0f} N", measured, contact.obstacle or "unnamed"))
    return rows


def _facts(instant: Instant, balance: Balance) -> list[tuple[str, str]]:
    state = instant.state
    found = [("commanded force F", f"{np.hypot(*balance.tether_n):.1f} N")]
    found.append(("resultant, solved", f"{np.hypot(*balance.resultant_n):.1f} N"))
    if instant.felt:
        found.append(("resultant, measured", f"{felt_along_n(instant, balance.resultant_n):.1f} N"))
    if state is not None and state.propulsion_torque_nm is not None:
        found.append(("torque of the propulsion joint", f"{state.propulsion_torque_nm:.2f} N·m"))
    if state is not None and state.torque_headroom_nm is not None:
        found.append(("torque left to its limit", f"{state.torque_headroom_nm:.2f} N·m"))
    if state is not None and state.saturated:
        found.append(("torque", "at its limit"))
    return [(name, value.replace("-", "−")) for name, value in found]


def _why_no_polygon(record: RunRecord, summary: RunSummary) -> str:
    if not record.control:
        return "No force polygon: the run's telemetry holds no message of the controller."
    if not any(state.push_points for state in record.control):
        return f"No force polygon: controller {summary.controller} solved for no push-points."
    if np.isnan(record.position_w).all():
        return "No force polygon in a top view: the robot has no pose sensor, so nobody knows where it was."
    return (
        "No force polygon: at no time did the snake locomote on three push-points whose forces balance. Last word of "
        f"the controller: {record.control[-1].reason or 'none'}."
    )


def _joints(record: RunRecord, intervals: list[Propulsion]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for joint in most_used_joints(intervals):
        own = [one for one in intervals if one.joint == joint]
        spans = ", ".join(f"{one.start_s:.2f}–{one.end_s:.2f} s" for one in own[:4])
        found.append(
            {
                "joint": joint,
                "name": record.description.joints[joint].name,
                "spans": spans + (f" and {len(own) - 4} more times" if len(own) > 4 else ""),
                "angle": figures.joint_angle(record, joint, intervals),
                "torque": figures.joint_torque(record, joint, intervals),
            }
        )
    return found


def _loads(record: RunRecord, intervals: list[Propulsion]) -> dict[str, Any]:
    felt = record.config.robot.sensors.contacts is not None
    return {
        "torque_map": figures.torque_map(record, intervals),
        "torque_use": figures.torque_use(record),
        "full_colour_nm": figures.full_colour_nm(record),
        "contacts": figures.contacts(record) if felt else [],
    }


def _faults(record: RunRecord, summary: RunSummary) -> list[list[str]]:
    """Every fault: when, where, what and why."""
    begin_s = float(record.time_s[0]) if len(record.time_s) else 0.0
    rows = [
        [f"{fault.tick / summary.rate_hz - begin_s:.2f} s", fault.what, fault.joint or "–", fault.cause]
        for fault in summary.faults
    ]
    if summary.faults_left_out:
        told = f"{summary.faults_left_out} more, between the first and the newest, are left out"
        rows.insert(FIRST_KEPT, ["…", "", "–", told])
    return rows


def _numbers(summary: RunSummary) -> list[list[str]]:
    """Every field with its unit and what it means, from the Struct itself."""
    hints = get_type_hints(RunSummary, include_extras=True)
    rows: list[list[str]] = []
    for field in msgspec.structs.fields(RunSummary):
        if field.name in ELSEWHERE:
            continue
        notes = getattr(hints[field.name], "__metadata__", ())
        meta: Meta | None = next((note for note in notes if isinstance(note, Meta)), None)
        unit = ((meta.extra_json_schema or {}).get("unit", "") if meta else "").removeprefix("1")
        rows.append([field.name, _said(getattr(summary, field.name)), unit, (meta.description or "") if meta else ""])
    return rows


def _said(value: Any) -> str:
    """A value in words; what is unknown says so."""
    if value is None:
        return "not known"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return shown(value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_said(inner)}" for key, inner in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(_said(inner) for inner in value) or "none"
    return str(value)


def _command(record: RunRecord, summary: RunSummary) -> str:
    here = Path.cwd()
    folder = record.folder.relative_to(here) if record.folder.is_relative_to(here) else record.folder
    return f"snakesim run {folder / CONFIG} --backend {summary.backend} --seed {summary.seed}"


def _swatch(kind: str) -> Markup:
    drawn = arrow((1, 7), (29, 7), kind, head=10)
    return Markup(f'<svg class="figure swatch" viewBox="0 0 30 14">{drawn}</svg>')
