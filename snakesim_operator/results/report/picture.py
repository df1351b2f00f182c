"""The best instant of a run as a picture of its own, for a README: top view, force polygon, and what they show."""

from pathlib import Path

import numpy as np

from snakesim_operator.results.page.palette import LIGHT, baked, joint_colours
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import Instant, best_instant
from snakesim_operator.results.report.polygon import polygon_drawing, units_per_n
from snakesim_operator.results.report.svg import arrow, element, figure, line, text, text_width
from snakesim_operator.results.report.top_view import drawing
from snakesim_operator.results.report.view import nodes_xy_w, views
from snakesim_operator.results.summary import RunSummary

FIGURE_STYLE = Path(__file__).parent / "figure.css"
WIDTH, EDGE = 920.0, 20.0
POLYGON_WIDTH = 250.0
ARROW = 150.0  # of the strongest force
HEAD, FOOT = 62.0, 40.0


def write_picture(record: RunRecord, summary: RunSummary, path: Path) -> None:
    """Write the picture. Raises ValueError when the run has no instant that can be drawn."""
    path.write_text(picture(record, summary), encoding="utf-8")


def picture(record: RunRecord, summary: RunSummary) -> str:
    """The SVG on a light ground, with its colours baked in, for viewers that know no CSS variables."""
    instant = best_instant(record)
    if instant is None:
        raise ValueError("no instant of this run can be drawn: it has no ticks, or the robot has no pose sensor")
    view_width = WIDTH - 2 * EDGE - (POLYGON_WIDTH if instant.balance is not None else 0.0)
    view = views(record, [instant], view_width, ARROW)[0]
    height = HEAD + view.height + FOOT
    parts = [
        element("style", FIGURE_STYLE.read_text(encoding="utf-8")),
        element("rect", x=0, y=0, width=WIDTH, height=height, rx=8, style=f"fill:{LIGHT['card']}"),
        _words(record, summary, instant),
        _inset(EDGE, HEAD, view.width, view.height, drawing(record, instant, view, nodes_xy_w(record, instant))),
    ]
    if instant.balance is not None:
        tall = min(view.height, 300.0)
        scale = units_per_n([instant.balance], POLYGON_WIDTH, tall, upright=view.upright)
        drawn = polygon_drawing(instant.balance, POLYGON_WIDTH, tall, scale, upright=view.upright)
        left = EDGE + view.width
        parts.append(line((left + 4, HEAD), (left + 4, HEAD + view.height), "zero"))
        parts.append(_inset(left, HEAD + (view.height - tall) / 2, POLYGON_WIDTH, tall, drawn))
        parts.append(text(left + POLYGON_WIDTH / 2, HEAD + 4, "force polygon", "small soft", anchor="middle"))
    parts.append(_legend(instant, height - 16))
    label = f"{record.config.title or summary.scenario}: the snake from above at {instant.time_s:.2f} s"
    drawn = figure(WIDTH, height, label, *parts, xmlns="http://www.w3.org/2000/svg", width=WIDTH, height=height)
    return baked(drawn, LIGHT | joint_colours(len(record.description.joints), dark=False)) + "\n"


def _inset(x: float, y: float, width: float, height: float, content: str) -> str:
    return element("svg", content, x=x, y=y, width=width, height=height, overflow="hidden")


def _words(record: RunRecord, summary: RunSummary, instant: Instant) -> str:
    second = f"{summary.robot} in {summary.scene}, {summary.controller}, t = {instant.time_s:.2f} s"
    if instant.propulsion_joint is not None:
        second += f"; {record.description.joints[instant.propulsion_joint].name} propels"
    if instant.balance is not None:
        second += f", resultant {np.hypot(*instant.balance.resultant_n):.0f} N along the path"
    title = text(EDGE, 30, record.config.title or summary.scenario, "strong")
    return title + text(EDGE, 50, second, "small soft")


def _legend(instant: Instant, y: float) -> str:
    entries: list[tuple[str, str]] = []
    if instant.balance is not None:
        entries += [
            ("solved", "solved force"),
            ("resultant", "their resultant, which propels"),
            ("commanded", "commanded force F"),
            ("frame", "normal, tangent"),
        ]
    if instant.felt:
        entries.append(("felt", "measured force"))
    parts: list[str] = []
    x = EDGE
    for class_, name in entries:
        parts.append(arrow((x, y - 4), (x + 26, y - 4), class_, head=9) + text(x + 32, y, name, "small soft"))
        x += 32 + text_width(name, 11.5) + 18
    return "".join(parts)
