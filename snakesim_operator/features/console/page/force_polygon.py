"""Draws the force polygon of a snapshot as SVG, and tabulates the forces at push-points. Pure.

The polygon has the contact forces on the body from tail to head, each beginning where the one before ends, and their
resultant.
"""

from html import escape
from itertools import pairwise

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import ControlState
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import MIN_FORCE_N
from snakesim_operator.features.console.scene.scene_colors import MEASURED_FORCE, RESULTANT, Color
from snakesim_operator.results.page import svg

WIDTH_PX = 380.0
HEIGHT_PX = 250.0
MARGIN_PX = 34.0
# That the height stands for: few, so that the scale seldom jumps.
SCALE_HEIGHTS_N = 5.0, 10.0, 20.0, 50.0, 100.0, 200.0
MIN_LABELED_PX = 26.0  # shorter arrows have no number
MIN_ARROW_PX = 1.0  # shorter arrows are not drawn
ARROW_HEAD_PX = 11.0
LABEL_DISTANCE_PX = 20.0  # of a label from the middle of its arrow
FONT_PX = 11
NO_FORCES = (
    "<div style='padding:.3em .6em;opacity:.7'>no contact force is measured on the body now</div>"
)


def draw_force_polygon(snapshot: RobotSnapshot) -> str:
    """Draw the measured contact forces on the body as a force polygon in HTML, with x of the world to the right."""
    forces_n = _list_forces_n(snapshot)
    if not len(forces_n):
        return NO_FORCES
    corners_n = np.vstack([np.zeros(2), np.cumsum(forces_n, axis=0)])
    px_per_n, span_n = _choose_scale(corners_n)
    corners_px = _convert_to_pixels(corners_n, px_per_n)
    resultant_n = float(np.linalg.norm(corners_n[-1]))
    arrows = [
        _draw_arrow(start, end, MEASURED_FORCE, px_per_n) for start, end in pairwise(corners_px)
    ]
    arrows.append(_draw_arrow(corners_px[0], corners_px[-1], RESULTANT, px_per_n))
    scale_bar = _draw_scale_bar(span_n / 5, px_per_n)
    label = f"Force polygon of the contact forces on the body; resultant {resultant_n:.1f} N"
    drawing = svg.make_svg(WIDTH_PX, HEIGHT_PX, label, *arrows, scale_bar)
    return (
        f"<div style='padding:.2em .6em;font-size:.85em'>Contact forces on the body, tail to head; resultant "
        f"{resultant_n:.1f} N</div>{drawing}"
    )


def _list_forces_n(snapshot: RobotSnapshot) -> Floats:
    """Return the horizontal contact forces that are strong enough to be drawn, (n, 2), from tail to head."""
    if snapshot.world is None:
        return np.zeros((0, 2))
    contacts = sorted(snapshot.world.contacts, key=lambda contact: contact.body_s_m)
    forces_n = np.array([contact.force_w[:2] for contact in contacts]).reshape(-1, 2)
    return forces_n[np.linalg.norm(forces_n, axis=1) > MIN_FORCE_N]


def _choose_scale(corners_n: Floats) -> tuple[float, float]:
    """Return pixels per newton, and the force in N that the height of the drawing stands for."""
    drawn_px = np.array([WIDTH_PX, HEIGHT_PX]) - 2 * MARGIN_PX
    extent_n = corners_n.max(axis=0) - corners_n.min(axis=0)
    needed_n = float(np.max(extent_n / drawn_px)) * drawn_px[1]
    span_n = next((span_n for span_n in SCALE_HEIGHTS_N if span_n >= needed_n), needed_n)
    return drawn_px[1] / span_n, span_n


def _convert_to_pixels(corners_n: Floats, px_per_n: float) -> Floats:
    """Return the corners in pixels, (n, 2), centered in the drawing; y of the page points down."""
    center_px = np.array([WIDTH_PX, HEIGHT_PX]) / 2
    center_n = (corners_n.min(axis=0) + corners_n.max(axis=0)) / 2
    return center_px + px_per_n * (corners_n - center_n) * [1, -1]


def _draw_scale_bar(force_n: float, px_per_n: float) -> str:
    y = HEIGHT_PX - 8
    bar = svg.draw_line((8, y), (8 + force_n * px_per_n, y), stroke="currentColor", stroke_width=2)
    return bar + svg.draw_text(8, y - 6, f"{force_n:.3g} N", fill="currentColor", font_size=FONT_PX)


def format_push_point_table(control: ControlState | None) -> str:
    """Format a table of the desired and the measured force at each push-point as HTML, from tail to head.

    The result is empty if the controller has no push-points, or does not publish both forces for each of them.
    """
    if control is None:
        return ""
    push_point_count = len(control.push_points)
    if (
        push_point_count == 0
        or len(control.desired_force_n) != push_point_count
        or len(control.measured_force_n) != push_point_count
    ):
        return ""
    rows: list[str] = []
    for point, desired_n, measured_n in zip(
        control.push_points, control.desired_force_n, control.measured_force_n, strict=True
    ):
        name = escape(point.obstacle or "unnamed")
        measured = "unknown" if measured_n is None else f"{measured_n:.1f}"
        rows.append(f"<tr><td>{name}</td><td>{desired_n:.1f}</td><td>{measured}</td></tr>")
    header_row = "<tr><th>push-point</th><th>desired, N</th><th>measured, N</th></tr>"
    style = "padding:.2em .6em;font-size:.85em;text-align:left;width:100%"
    return f"<table style='{style}'>{header_row}{''.join(rows)}</table>"


def _draw_arrow(start: Floats, end: Floats, color: Color, px_per_n: float) -> str:
    """Return an arrow between two points in pixels, labeled with its force in newtons."""
    length_px = float(np.linalg.norm(end - start))
    if length_px < MIN_ARROW_PX:
        return ""
    color_text = f"rgb{color}"
    start_x, start_y = start.tolist()
    end_x, end_y = end.tolist()
    arrow = svg.draw_arrow((start_x, start_y), (end_x, end_y), head=ARROW_HEAD_PX, color=color_text)
    if length_px <= MIN_LABELED_PX:
        return arrow
    along = (end - start) / length_px
    side = np.array([-along[1], along[0]])
    x, y = (start + end) / 2 + LABEL_DISTANCE_PX * side
    label = f"{length_px / px_per_n:.1f} N"
    return arrow + svg.draw_text(
        x, y + 4, label, anchor="middle", fill=color_text, font_size=FONT_PX
    )
