"""The comparison as one page that needs no network, no program and no other file; it looks like a run's report."""

from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.compare import figures
from snakesim_operator.results.compare.difference import Difference, Gap, HandOver, Worst
from snakesim_operator.results.compare.verdict import Within, sentences, who_propelled
from snakesim_operator.results.report.html import (
    absent,
    document,
    paragraph,
    responsive,
    section,
    shown,
    table,
    tile,
    words,
)
from snakesim_operator.results.report.page import HALF_WIDTH, script, styles
from snakesim_operator.results.report.palette import joint_class
from snakesim_operator.results.report.svg import line

Floats = NDArray[np.float64]
UNKNOWN = "–"
HAND_OVERS_SHOWN = 40


def page(difference: Difference, asked: Within | None = None) -> str:
    """The whole page. asked: what `--within` asked for."""
    body = "".join(
        [
            _header(difference, asked),
            _compared(difference),
            _advance(difference),
            _map(difference, "angles", "Angles", difference.angle),
            _map(difference, "torques", "Torques", difference.torque),
            _worst(difference),
            _propulsion(difference),
            _numbers(difference),
        ]
    )
    style = styles() + (Path(__file__).parent / "compare.css").read_text(encoding="utf-8")
    return document(_title(difference), style, body, script())


def _title(difference: Difference) -> str:
    names = [record.folder.name for record in (difference.a, difference.b)]
    return f"{names[0]} and {names[1]}"


def _header(difference: Difference, asked: Within | None) -> str:
    a, b = difference.a, difference.b
    kind = "" if asked is None else " good" if asked.holds else " bad"
    said = [*sentences(difference), *([f"{asked.words[:1].upper()}{asked.words[1:]}."] if asked is not None else [])]
    facts = [f"A is {a.folder}", f"B is {b.folder}", f"{difference.aligned.time_s[-1]:.2f} s, {difference.aligned.how}"]
    return (
        '<header id="header"><p class="kicker">SnakeSIM run comparison '
        f"<span>{words(a.config.name)}</span></p><h1>{words(_title(difference))}</h1>"
        f'<p class="facts">{" · ".join(f"<span>{words(fact)}</span>" for fact in facts)}</p>'
        f'<p class="verdict{kind}">{words(" ".join(said))}</p><div class="tiles">{_tiles(difference)}</div></header>'
    )


def _tiles(difference: Difference) -> str:
    moved, both = difference.advance, difference.hand_overs
    percent = moved.percent if moved is not None else None
    angle, torque, parted = difference.angle, difference.torque, difference.parted
    rows = [
        ("A moved", f"{moved.a_m:.3f}" if moved else UNKNOWN, "m"),
        ("B moved", f"{moved.b_m:.3f}" if moved else UNKNOWN, "m"),
        ("B relative to A", _signed(percent), "%"),
        (
            f"first more than {difference.apart_rad:g} rad apart",
            f"{parted.time_s:.2f}" if parted else "never",
            "s" if parted else "",
        ),
        ("hand-overs that agree", f"{both.agreed} of {max(len(both.a), len(both.b))}", ""),
        ("angles differ, RMS", _digits(angle.rms), "rad"),
        ("worst angle", _digits(angle.worst.difference if angle.worst else None), "rad"),
        ("torques differ, RMS", _digits(torque.rms), "N·m"),
        ("worst torque", _digits(torque.worst.difference if torque.worst else None), "N·m"),
        ("torques correlate", _correlation(torque.correlation), ""),
    ]
    return "".join(tile(name, value.replace("-", "−"), unit) for name, value, unit in rows)


def _compared(difference: Difference) -> str:
    folders = [["folder", str(difference.a.folder), str(difference.b.folder), ""]]
    rows = folders + [[one.key, one.a, one.b, "differs" if one.a != one.b else ""] for one in difference.compared]
    hosts = (difference.a.host, difference.b.host)
    rows.append(["faults", *("; ".join(f.cause for f in host.faults) or "none" for host in hosts), ""])
    rows.append(["not known", *("; ".join(record.lacks) or UNKNOWN for record in (difference.a, difference.b)), ""])
    digests = [host.command_digest[:16] for host in hosts]
    rows.append(["command digest", *digests, "the same" if digests[0] == digests[1] else ""])
    parts = [table(["", "A", "B", ""], rows, "compared"), "<h3>Settings that differ</h3>"]
    settings = [[one.key, one.a, one.b] for one in difference.settings]
    if settings:
        parts.append(paragraph("A comparison is fair when only what is meant stands here.", "lead"))
        parts.append(table(["setting", "A", "B"], settings, "settings"))
    else:
        parts.append(absent("No setting differs: both runs were asked for the same."))
    return section("compared", "What was compared", *parts)


def _advance(difference: Difference) -> str:
    moved = difference.advance
    title = "Advance"
    if moved is None:
        return section("advance", title, absent("No distance: there is no measure of it that both runs have."))
    return section(
        "advance",
        title,
        paragraph(
            f"{moved.what[:1].upper()}{moved.what[1:]}. Below, how far B was ahead of A." + _dashed(difference), "lead"
        ),
        _legend(),
        responsive(lambda width: figures.advance(difference, moved, width)),
        responsive(lambda width: figures.advance_gap(difference, moved, width)),
    )


def _dashed(difference: Difference) -> str:
    if difference.parted is None:
        return ""
    return f" Dashed: the first instant at which a joint's angles are more than {difference.apart_rad:g} rad apart."


def _map(difference: Difference, anchor: str, title: str, gap: Gap) -> str:
    worst = gap.worst
    if worst is None:
        return section(anchor, title, absent(f"No {gap.what} is known in both runs."))
    if gap.same:
        return section(anchor, title, absent(f"No difference: every {gap.what} is the same at every instant."))
    if not worst.difference:
        return section(anchor, title, absent(f"No difference where the {gap.what} is known in both runs."))
    lead = (
        f"B − A, a row a joint, head on top. Orange: B is greater; blue: A is. Full colour is the worst, "
        f"{shown(abs(worst.difference), 3)} {gap.unit}, of {difference.joints[worst.joint]} at {worst.time_s:.2f} s."
        + (_dashed(difference) if gap is difference.angle else "")
    )
    return section(
        anchor, title, paragraph(lead, "lead"), responsive(lambda width: figures.gap_map(difference, gap, width))
    )


def _worst(difference: Difference) -> str:
    chosen: dict[int, list[str]] = {}
    for gap in (difference.angle, difference.torque):
        if gap.worst is not None and gap.worst.difference:
            chosen.setdefault(gap.worst.joint, []).append(f"worst {gap.what}, {_worst_words(gap.worst, gap.unit)}")
    title = "The joints that differ most"
    if not chosen:
        return section("worst", title, absent("No joint: all angles and torques that are known are the same."))
    a, b = difference.aligned.a, difference.aligned.b
    blocks: list[str] = []
    for joint, why in chosen.items():
        name = words(difference.joints[joint])
        angle = figures.overlay(difference, difference.angle, a.angle_rad, b.angle_rad, joint, HALF_WIDTH)
        torque = figures.overlay(difference, difference.torque, a.torque_nm, b.torque_nm, joint, HALF_WIDTH)
        blocks.append(
            f'<article class="joint-pair" data-joint="{name}"><h3><i class="chip {joint_class(joint)}"></i>{name} '
            f"<small>{words('; '.join(why))}</small></h3><div class='pair'><div class=\"angle\">{angle}</div>"
            f'<div class="torque">{torque}</div></div></article>'
        )
    return section("worst", title, _legend(), *blocks)


def _propulsion(difference: Difference) -> str:
    both, title = difference.hand_overs, "Propulsion"
    if not both.a and not both.b:
        return section("propulsion", title, absent("No joint propelled in either run."))
    said = who_propelled(difference)
    rows: list[list[str]] = []
    for i, (a, b) in enumerate(zip_longest(both.a, both.b)):
        later = f"{b.time_s - a.time_s:+.2f} s".replace("-", "−") if i < both.agreed and a and b else UNKNOWN
        rows.append([str(i + 1), _taken(difference, a), _taken(difference, b), later])
    parts = [table(["", "A", "B", "B later by"], rows[:HAND_OVERS_SHOWN])]
    if len(rows) > HAND_OVERS_SHOWN:
        parts.append(paragraph(f"And {len(rows) - HAND_OVERS_SHOWN} more.", "note"))
    return section(
        "propulsion",
        title,
        paragraph(f"{said[:1].upper()}{said[1:]}. In each row A above, B below." + _dashed(difference), "lead"),
        _legend(),
        responsive(lambda width: figures.hand_overs(difference, width)),
        *parts,
    )


def _taken(difference: Difference, one: HandOver | None) -> str:
    return f"{difference.joints[one.joint]} at {one.time_s:.2f} s" if one is not None else UNKNOWN


def _numbers(difference: Difference) -> str:
    overall = [
        [
            gap.what,
            _with_unit(gap.rms, gap.unit),
            _with_unit(gap.worst.difference if gap.worst else None, gap.unit),
            f"{difference.joints[gap.worst.joint]} at {gap.worst.time_s:.2f} s" if gap.worst else UNKNOWN,
            _correlation(gap.correlation),
        ]
        for gap in difference.gaps
    ]
    angle, torque, speed = difference.angle, difference.torque, difference.speed
    each = [
        [name]
        + [
            cell
            for gap in (angle, torque, speed)
            for cell in (_digits(float(gap.joint_rms[joint])), _at(gap.joint_worst[joint]))
        ]
        for joint, name in reversed(list(enumerate(difference.joints)))
    ]
    head = ["joint"]
    for gap in (angle, torque, speed):
        head += [f"{gap.what} RMS, {gap.unit}", "worst"]
    tracking = [_with_unit(told, "rad") for told in difference.tracking_rad]
    notes = [f"Angle off its own target in position mode, RMS: A {tracking[0]}, B {tracking[1]}."]
    if difference.other_mode:
        notes.append(
            f"Joints were in another mode in {100 * difference.other_mode:.1f} % of the time; "
            "targets are not compared there."
        )
    return section(
        "numbers",
        "Numbers",
        paragraph(
            f"B − A over {difference.aligned.time_s[-1]:.2f} s from the first arming, {difference.aligned.how}.", "lead"
        ),
        table(["all joints", "RMS", "worst", "where and when", "correlation"], overall, "figures-wide"),
        paragraph(" ".join(notes), "note"),
        "<h3>Joint by joint</h3>",
        table(head, each, "figures-wide"),
    )


def _legend() -> str:
    items = "".join(
        f'<li><svg class="figure swatch" viewBox="0 0 30 14">{line((1, 7), (29, 7), f"curve run-{name.lower()}")}</svg>'
        f"{name}</li>"
        for name in ("A", "B")
    )
    return f'<ul class="legend">{items}</ul>'


def _worst_words(worst: Worst, unit: str) -> str:
    return f"{shown(worst.difference, 3)} {unit} at {worst.time_s:.2f} s"


def _at(worst: Worst | None) -> str:
    return f"{shown(worst.difference, 3)} at {worst.time_s:.2f} s" if worst is not None else UNKNOWN


def _with_unit(value: float | None, unit: str) -> str:
    return UNKNOWN if value is None else f"{shown(value, 3)} {unit}"


def _signed(percent: float | None) -> str:
    text = f"{percent:+.1f}" if percent is not None else UNKNOWN
    return "0.0" if text in ("+0.0", "-0.0") else text


def _correlation(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.3f}"


def _digits(value: float | None) -> str:
    return UNKNOWN if value is None or not np.isfinite(value) else shown(value, 3)
