"""The page: header, instants, overview, joints, loads, numbers. A section with nothing to show says why."""

from pathlib import Path

import msgspec
import numpy as np

from snakesim_operator.results.record import CONFIG, RunRecord
from snakesim_operator.results.report import figures, tables
from snakesim_operator.results.report.cards import instants_section
from snakesim_operator.results.report.html import absent, document, paragraph, responsive, section, shown, tile, words
from snakesim_operator.results.report.palette import DARK, LIGHT, joint_class, variables
from snakesim_operator.results.report.svg import line
from snakesim_operator.results.report.timeline import (
    Propulsion,
    distance,
    end_s,
    most_used_joints,
    propulsion_intervals,
    propulsion_phase_s,
    zero_s,
)
from snakesim_operator.results.report.torque_map import full_colour_nm, torque_map
from snakesim_operator.results.report.verdict import tiles, verdict
from snakesim_operator.results.summary import RunSummary

HERE = Path(__file__).parent
HALF_WIDTH = 500.0
NO_TICKS = "The run has no ticks: the robot was never armed, so nothing was recorded."


def page(record: RunRecord, summary: RunSummary) -> str:
    """The whole page."""
    intervals = propulsion_intervals(record)
    body = "".join(
        [
            _header(record, summary),
            instants_section(record, summary),
            _overview(record, summary, intervals),
            _joints(record, summary, intervals),
            _loads(record, summary, intervals),
            _numbers(record, summary),
            _again(record, summary),
        ]
    )
    title = record.config.title or summary.scenario
    return document(title, styles(), body, script())


def styles() -> str:
    """Colours of both themes, then the rules. Paper is always light."""
    light, dark = variables(LIGHT), variables(DARK)
    themes = f":root{{{light}}}@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}"
    return themes + "".join((HERE / name).read_text(encoding="utf-8") for name in ("figure.css", "report.css"))


def script() -> str:
    """One time cursor through all charts of a page."""
    return (HERE / "report.js").read_text(encoding="utf-8")


def _header(record: RunRecord, summary: RunSummary) -> str:
    judged = verdict(record, summary)
    facts = [
        f"robot {summary.robot}, {len(record.description.joints)} joints",
        f"scene {summary.scene}",
        f"controller {summary.controller}",
        f"backend {summary.backend}",
        f"{summary.pace}, {summary.rate_hz:g} Hz",
        f"seed {summary.seed}",
    ]
    lacks = paragraph(f"The record lacks something. {'. '.join(summary.lacks)}.", "lacks") if summary.lacks else ""
    shown_tiles = "".join(tile(one.name, one.value, one.unit, alarming=one.alarming) for one in tiles(record, summary))
    return (
        f'<header id="header"><p class="kicker">SnakeSIM run report <span>{words(summary.scenario)}</span></p>'
        f"<h1>{words(record.config.title or summary.scenario)}</h1>"
        f'<p class="facts">{" · ".join(f"<span>{words(fact)}</span>" for fact in facts)}</p>'
        f'<p class="verdict {judged.kind}">{words(judged.words)}</p>{lacks}'
        f'<div class="tiles">{shown_tiles}</div></header>'
    )


def _overview(record: RunRecord, summary: RunSummary, intervals: list[Propulsion]) -> str:
    title = "Advance and hand-over"
    if not len(record.time_s):
        return section("overview", title, absent(NO_TICKS))
    moved = distance(record)
    parts: list[str] = []
    if moved is None:
        parts.append(absent("No distance: the robot has no pose sensor, and its controller told no place on the path."))
    else:
        lead = f"Line: {moved.what}. Bar on top: state of locomotion"
        lead += ", red underneath while the controller reported a jam. " if summary.jammed else ". "
        lead += "Coloured intervals: the joint that propelled." if intervals else ""
        parts.append(paragraph(lead, "lead"))
    if not record.control:
        parts.append(absent("No states: the run's telemetry holds no message of the controller."))
    elif not intervals:
        parts.append(absent(f"No hand-over: controller {summary.controller} named no propulsion joint at any time."))
    parts.append(responsive(lambda width: figures.overview(record, moved, intervals, width)))
    return section("overview", title, *parts)


def _joints(record: RunRecord, summary: RunSummary, intervals: list[Propulsion]) -> str:
    title = "The joints that propelled"
    if not intervals:
        why = f"No joint propelled: controller {summary.controller} named no propulsion joint."
        return section("joints", title, absent(why if len(record.time_s) else NO_TICKS))
    joints = most_used_joints(intervals)
    among = len({one.joint for one in intervals})
    lead = (
        f"The {len(joints)} of {among} that propelled longest. " if among > len(joints) else ""
    ) + "Left the angle, right the torque; the two-sided arrows span the time in which the joint propelled."
    phase_s = propulsion_phase_s(record, intervals)
    if phase_s[1] - phase_s[0] < 0.99 * end_s(record):
        lead += f" Shown is the propulsion phase, {phase_s[0]:.1f} to {phase_s[1]:.1f} s of the run."
    blocks: list[str] = []
    for joint in joints:
        own = [one for one in intervals if one.joint == joint]
        spans = ", ".join(f"{one.start_s:.2f}–{one.end_s:.2f} s" for one in own[:4])
        spans += f" and {len(own) - 4} more times" if len(own) > 4 else ""
        name = record.description.joints[joint].name
        angle = figures.joint_angle(record, joint, intervals, phase_s, HALF_WIDTH)
        torque = figures.joint_torque(record, joint, intervals, phase_s, HALF_WIDTH)
        blocks.append(
            f'<article class="joint-pair" data-joint="{words(name)}"><h3><i class="chip {joint_class(joint)}"></i>'
            f"{words(name)} <small>propelled {words(spans)}</small></h3><div class='pair'>"
            f'<div class="angle">{angle}</div>'
            f'<div class="torque">{torque}</div></div></article>'
        )
    return section("joints", title, paragraph(lead, "lead"), _line_legend(record), *blocks)


def _line_legend(record: RunRecord) -> str:
    entries = [
        ("curve measured", "measured"),
        ("curve reference", "reference angle; commanded torque while in torque mode"),
        ("limit", "torque limit of the joint"),
    ]
    limits = [joint.torque_limit_nm for joint in record.description.joints]
    if bool((record.torque_limit_nm < figures.LOWERED * np.array(limits)).any()):
        entries.append(("curve lowered", "limit that the controller set below it"))
    items = "".join(
        f'<li><svg class="figure swatch" viewBox="0 0 30 14">{line((1, 7), (29, 7), class_)}</svg>{words(name)}</li>'
        for class_, name in entries
    )
    return f'<ul class="legend">{items}</ul>'


def _loads(record: RunRecord, summary: RunSummary, intervals: list[Propulsion]) -> str:
    title = "Loads and limits"
    if not len(record.time_s):
        return section("loads", title, absent(NO_TICKS))
    saturated = summary.torque_saturated_fraction or 0.0
    parts = [
        "<h3>Torque of every joint</h3>",
        paragraph(
            "A row a joint, head on top. Orange is positive, a yaw joint turning what is ahead of it to the left; blue "
            f"is negative; full colour is {shown(full_colour_nm(record), 2)} N·m."
            + (" Frames mark propulsion." if intervals else ""),
            "lead",
        ),
        responsive(lambda width: torque_map(record, intervals, width)),
        "<h3>Hardest-worked joint</h3>",
        paragraph(
            f"At a torque limit in {100 * saturated:.1f} % of the ticks; those are drawn in red."
            if saturated
            else "No joint was at its torque limit at any tick.",
            "lead",
        ),
        responsive(lambda width: figures.torque_use(record, width)),
        "<h3>Contacts</h3>",
    ]
    if record.config.robot.sensors.contacts is None:
        parts.append(absent("No contact forces: the robot has no contact sensor."))
    else:
        parts.append(responsive(lambda width: figures.contact_force(record, width)))
        parts.append(responsive(lambda width: figures.contact_count(record, width)))
    limited = tables.counts(summary.limited_commands, "limit", "The gate changed no set-point.")
    refused = tables.counts(summary.rejected_commands, "reason", "The gate refused no command.")
    parts.append(
        f'<div class="pair"><div><h3>Set-points limited by the gate</h3>{limited}</div>'
        f"<div><h3>Commands refused</h3>{refused}</div></div>"
    )
    return section("loads", title, *parts)


def _numbers(record: RunRecord, summary: RunSummary) -> str:
    return section(
        "numbers",
        "Numbers",
        f"<h3>Faults</h3>{tables.faults(summary, zero_s(record))}",
        f"<h3>Summary</h3>{tables.all_numbers(summary)}",
    )


def _again(record: RunRecord, summary: RunSummary) -> str:
    here = Path.cwd()
    folder = record.folder.relative_to(here) if record.folder.is_relative_to(here) else record.folder
    command = f"snakesim run {folder / CONFIG} --backend {summary.backend} --seed {summary.seed}"
    plain = msgspec.json.format(msgspec.json.encode(summary.config), indent=2).decode()
    same = (
        f"In lockstep it gives the same command digest, {summary.command_digest[:16]}…"
        if summary.pace == "lockstep"
        else f"The pace was {summary.pace}, so another run is alike but not identical."
    )
    return section(
        "again",
        "Repeat this run",
        f"<pre><code>{words(command)}</code></pre>",
        paragraph(same, "lead"),
        f"<details><summary>Effective configuration</summary><pre>{words(plain)}</pre></details>",
    )
