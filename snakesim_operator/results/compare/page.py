"""The comparison as one page that needs no network, no program and no other file; it looks like a run's report."""

from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from snakesim_operator.results.compare import figures
from snakesim_operator.results.compare.difference import Difference, Gap, HandOver, Worst
from snakesim_operator.results.compare.verdict import Within, sentences, who_propelled
from snakesim_operator.results.page.html import render, shown
from snakesim_operator.results.report.verdict import Tile

UNKNOWN = "–"
HAND_OVERS_SHOWN = 40


def page(difference: Difference, asked: Within | None = None) -> str:
    """The whole page. asked: what `--within` asked for."""
    said = [*sentences(difference), *([f"{asked.words[:1].upper()}{asked.words[1:]}."] if asked is not None else [])]
    moved, both = difference.advance, difference.hand_overs
    return render(
        Path(__file__).parent / "compare.html",
        len(difference.joints),
        styles=[],
        scripts=[],
        title=" and ".join(record.folder.name for record in (difference.a, difference.b)),
        difference=difference,
        kind="" if asked is None else "good" if asked.holds else "bad",
        said=" ".join(said),
        tiles=_tiles(difference),
        compared=_compared(difference),
        settings=[[one.key, one.a, one.b] for one in difference.settings],
        advance=figures.advance(difference, moved) if moved else [],
        maps=[
            _map(difference, title, gap)
            for title, gap in (("Angles", difference.angle), ("Torques", difference.torque))
        ],
        worst=_worst(difference),
        hand_overs=figures.hand_overs(difference) if both.a or both.b else None,
        who_propelled=who_propelled(difference),
        turns=_turns(difference),
        most_turns=HAND_OVERS_SHOWN,
        **_numbers(difference),
    )


def _tiles(difference: Difference) -> list[Tile]:
    """What both have; nothing of what neither has."""
    moved, both = difference.advance, difference.hand_overs
    angle, torque, parted = difference.angle, difference.torque, difference.parted
    most = max(len(both.a), len(both.b))
    apart = f"first more than {difference.apart_rad:g} rad apart"
    found = [
        ("A moved", f"{moved.a_m:.3f}" if moved else UNKNOWN, "m"),
        ("B moved", f"{moved.b_m:.3f}" if moved else UNKNOWN, "m"),
        ("B relative to A", _signed(moved.percent if moved else None), "%"),
        (apart, f"{parted.time_s:.2f}" if parted else "never", "s" if parted else ""),
        (
            "hand-overs that agree",
            f"{both.agreed} of {most}" if (most := max(len(both.a), len(both.b))) else UNKNOWN,
            "",
        ),
        ("angles differ, RMS", _digits(angle.rms), "rad"),
        ("worst angle", _digits(angle.worst.difference if angle.worst else None), "rad"),
        ("torques differ, RMS", _digits(torque.rms), "N·m"),
        ("worst torque", _digits(torque.worst.difference if torque.worst else None), "N·m"),
        ("torques correlate", _correlation(torque.correlation), ""),
    ]
    return [Tile(name, value.replace("-", "−"), unit) for name, value, unit in found if value != UNKNOWN]


def _compared(difference: Difference) -> list[list[str]]:
    records = (difference.a, difference.b)
    digests = [record.host.command_digest[:16] for record in records]
    return [
        ["folder", *(str(record.folder) for record in records), ""],
        *([one.key, one.a, one.b, "differs" if one.a != one.b else ""] for one in difference.compared),
        ["faults", *("; ".join(fault.cause for fault in record.host.faults) or "none" for record in records), ""],
        ["not known", *("; ".join(record.lacks) or UNKNOWN for record in records), ""],
        ["command digest", *digests, "the same" if digests[0] == digests[1] else ""],
    ]


def _map(difference: Difference, title: str, gap: Gap) -> dict[str, Any]:
    worst = gap.worst
    if worst is None:
        why = f"No {gap.what} is known in both runs."
    elif gap.same:
        why = f"No difference: every {gap.what} is the same at every instant."
    elif not worst.difference:
        why = f"No difference where the {gap.what} is known in both runs."
    else:
        lead = (
            "B − A, a row a joint, head on top. Orange: B is greater; blue: A is. Full colour is the worst, "
            f"{shown(abs(worst.difference), 3)} {gap.unit}, "
            f"of {difference.joints[worst.joint]} at {worst.time_s:.2f} s."
        )
        return {"title": title, "why": None, "lead": lead, "figure": figures.gap_map(difference, gap)}
    return {"title": title, "why": why}


def _worst(difference: Difference) -> list[dict[str, Any]]:
    """The joints that differ most, and why they are shown."""
    chosen: dict[int, list[str]] = {}
    for gap in (difference.angle, difference.torque):
        if gap.worst is not None and gap.worst.difference:
            words = f"{shown(gap.worst.difference, 3)} {gap.unit} at {gap.worst.time_s:.2f} s"
            chosen.setdefault(gap.worst.joint, []).append(f"worst {gap.what}, {words}")
    a, b = difference.aligned.a, difference.aligned.b
    return [
        {
            "joint": joint,
            "name": difference.joints[joint],
            "why": "; ".join(why),
            "angle": figures.overlay(difference, difference.angle, a.angle_rad, b.angle_rad, joint),
            "torque": figures.overlay(difference, difference.torque, a.torque_nm, b.torque_nm, joint),
        }
        for joint, why in chosen.items()
    ]


def _turns(difference: Difference) -> list[list[str]]:
    both = difference.hand_overs
    rows: list[list[str]] = []
    for i, (a, b) in enumerate(zip_longest(both.a, both.b)):
        later = f"{b.time_s - a.time_s:+.2f} s".replace("-", "−") if i < both.agreed and a and b else UNKNOWN
        rows.append([str(i + 1), _taken(difference, a), _taken(difference, b), later])
    return rows


def _taken(difference: Difference, one: HandOver | None) -> str:
    return f"{difference.joints[one.joint]} at {one.time_s:.2f} s" if one is not None else UNKNOWN


def _numbers(difference: Difference) -> dict[str, Any]:
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
    gaps = (difference.angle, difference.torque, difference.speed)
    each: list[list[str]] = []
    for joint, name in reversed(list(enumerate(difference.joints))):
        cells = [(_digits(float(gap.joint_rms[joint])), _at(gap.joint_worst[joint])) for gap in gaps]
        each.append([name, *(cell for pair in cells for cell in pair)])
    head = ["joint", *(cell for gap in gaps for cell in (f"{gap.what} RMS, {gap.unit}", "worst"))]
    tracking = [_with_unit(told, "rad") for told in difference.tracking_rad]
    note = f"Angle off its own target in position mode, RMS: A {tracking[0]}, B {tracking[1]}."
    if difference.other_mode:
        note += (
            f" Joints were in another mode in {100 * difference.other_mode:.1f} % of the time; "
            "targets are not compared there."
        )
    return {"overall": overall, "head": head, "each": each, "note": note}


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
