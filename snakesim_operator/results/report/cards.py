"""The four instants as cards: top view, force polygon, and the numbers beside it."""

import numpy as np

from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.html import absent, paragraph, section, shown, words
from snakesim_operator.results.report.instants import Balance, Instant, felt_along_n, plain_instants, pushing_instants
from snakesim_operator.results.report.palette import joint_class
from snakesim_operator.results.report.polygon import force_polygon, pretty
from snakesim_operator.results.report.svg import arrow, element
from snakesim_operator.results.report.top_view import top_view
from snakesim_operator.results.report.view import View, nodes_xy_w, views
from snakesim_operator.results.summary import RunSummary

WIDTH = 500.0
TITLE = "Four instants"


def instants_section(record: RunRecord, summary: RunSummary) -> str:
    """Top views and force polygons, or why there are none."""
    if not len(record.time_s):
        return section("instants", TITLE, absent("No instants: the run has no ticks."))
    chosen = pushing_instants(record)
    parts: list[str] = []
    if not chosen:
        parts.append(absent(why_no_polygon(record, summary)))
        chosen = plain_instants(record)
    if not chosen:
        parts.append(absent("No top views: the robot has no pose sensor, so nobody knows where it was."))
        return section("instants", TITLE, *parts)
    with_forces = chosen[0].balance is not None
    parts.append(_legend(with_forces, any(one.felt for one in chosen)))
    if with_forces:
        parts.append(paragraph(EXPLANATION, "lead"))
    cards = [
        _card(record, one, view, letter)
        for one, view, letter in zip(chosen, views(record, chosen, WIDTH), "abcd", strict=False)
    ]
    title = TITLE if len(chosen) == 4 else f"Instants ({len(chosen)})"
    return section("instants", title, *parts, f'<div class="cards">{"".join(cards)}</div>')


EXPLANATION = (
    "The red polygon is the balance that the controller solved for: fₛ + f₁ + f₂ + f₃ = 0. fₛ is the tether of the "
    "static model, pulling back along the path at o₁. The resultant of the contact forces, f₁ + f₂ + f₃ = −fₛ, is the "
    "heavy arrow: it points forward along the path at o₁. The robot has no tether, so this force is what drives it "
    "against friction and inertia."
)


def why_no_polygon(record: RunRecord, summary: RunSummary) -> str:
    """Why no instant shows solved forces."""
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


def _card(record: RunRecord, instant: Instant, view: View, letter: str) -> str:
    parts = [f'<div class="view">{top_view(record, instant, view)}</div>']
    joint = instant.propulsion_joint
    named = ""
    if joint is not None:
        name = record.description.joints[joint].name
        named = f'<i class="chip {joint_class(joint)}"></i>{words(name)} propels'
    elif instant.state is not None:
        named = words(f"{instant.state.state}: {instant.state.reason}")
    if instant.balance is not None:
        drawn = force_polygon(instant.balance, 236.0, 210.0, upright=view.upright)
        parts.append(f'<div class="balance"><div class="polygon">{drawn}</div>{_facts(instant, instant.balance)}</div>')
    elif instant.felt:
        nodes = nodes_xy_w(record, instant)
        pushed = shown(felt_along_n(instant, nodes[-1] - nodes[0]), 3)
        parts.append(paragraph(f"{_touches(instant)}, in sum {pushed} N in the direction from tail to head.", "note"))
    elif record.worlds and record.config.robot.sensors.contacts is not None:
        parts.append(paragraph("No contact was felt.", "note"))
    head = f"<h3>({letter}) {instant.time_s:.2f} s <small>{named}</small></h3>"
    return f'<article class="card instant">{head}{"".join(parts)}</article>'


def _touches(instant: Instant) -> str:
    count = len(instant.felt)
    return "1 measured contact" if count == 1 else f"{count} measured contacts"


def _facts(instant: Instant, balance: Balance) -> str:
    """Solved against measured at each push-point, and how good the balance is."""
    rows: list[str] = []
    for i, (contact, size) in enumerate(zip(balance.contacts, balance.size_n, strict=True)):
        felt = [np.hypot(*c.force_w[:2]) for c in instant.felt if c.obstacle == contact.obstacle]
        measured = f"{sum(felt):.0f} N" if felt else "–"
        rows.append(
            f"<tr><th scope='row'>{pretty(f'f_{i + 1}')}</th><td>{size:.0f} N</td><td>{measured}</td>"
            f"<td>{words(contact.obstacle or 'unnamed')}</td></tr>"
        )
    state = instant.state
    lines = [("resultant, solved", f"{np.hypot(*balance.resultant_n):.1f} N")]
    if instant.felt:
        lines.append(("resultant, felt", f"{felt_along_n(instant, balance.resultant_n):.1f} N"))
    lines.append(("polygon closes to", f"{balance.gap_n:.2f} N" if balance.gap_n >= 0.01 else "< 0.01 N"))
    if state is not None and state.propulsion_torque_nm is not None:
        lines.append(("propulsion torque", f"{state.propulsion_torque_nm:.2f} N·m"))
    if state is not None and state.torque_headroom_nm is not None:
        lines.append(("torque headroom", f"{state.torque_headroom_nm:.2f} N·m"))
    if state is not None and state.saturated:
        lines.append(("torque", "at its limit"))
    terms = "".join(f"<dt>{words(name)}</dt><dd>{words(value.replace('-', '−'))}</dd>" for name, value in lines)
    return (
        "<div class='figures'><table><thead><tr><td></td><th scope='col'>solved</th><th scope='col'>felt</th>"
        f"<th scope='col'>at</th></tr></thead><tbody>{''.join(rows)}</tbody></table><dl>{terms}</dl></div>"
    )


def _legend(with_forces: bool, with_felt: bool) -> str:
    dot = element("circle", cx=15, cy=7, r=5.5, class_="propelling legend-joint")
    entries: list[tuple[str, str]] = []
    if with_forces:
        entries += [
            (arrow((1, 7), (29, 7), "solved", head=10), "solved contact force fᵢ"),
            (arrow((1, 7), (29, 7), "resultant", head=12), "their resultant"),
            (arrow((1, 7), (29, 7), "tether", head=10), "fₛ of the model"),
            (arrow((1, 7), (29, 7), "frame", head=8), "contact normal, tangent"),
        ]
    if with_felt:
        entries.append((arrow((1, 7), (29, 7), "felt", head=8), "measured contact force"))
    if with_forces:
        entries.append((dot, "propulsion joint"))
    entries.append((element("line", x1=1, y1=7, x2=29, y2=7, class_="route"), "route"))
    items = "".join(
        f'<li><svg class="figure swatch" viewBox="0 0 30 14">{mark}</svg>{name}</li>' for mark, name in entries
    )
    return f'<ul class="legend">{items}</ul>'
