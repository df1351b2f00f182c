"""The force polygon of a snapshot: the contact forces on the body tail to head, and their resultant, as SVG. Pure."""

from html import escape
from itertools import pairwise

import numpy as np

from snakesim_hal.wire.messages import ControlState
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene import robot_scene
from snakesim_operator.features.console.scene.drawing import MIN_FORCE_N

WIDTH, HEIGHT, EDGE = 380.0, 250.0, 34.0
SPANS_N = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)  # that the height stands for: few, so that it seldom jumps
NAMED_PX = 26.0  # shorter arrows have no number


def force_polygon(snapshot: RobotSnapshot) -> str:
    """x of the world to the right, y upwards."""
    contacts = [] if snapshot.world is None else sorted(snapshot.world.contacts, key=lambda contact: contact.body_s_m)
    forces_n = np.array([contact.force_w[:2] for contact in contacts]).reshape(-1, 2)
    forces_n = forces_n[np.linalg.norm(forces_n, axis=1) > MIN_FORCE_N]
    if not len(forces_n):
        return "<div style='padding:.3em .6em;opacity:.7'>the body feels no contact force now</div>"
    corners_n = np.vstack([np.zeros(2), np.cumsum(forces_n, axis=0)])
    low_n, high_n = corners_n.min(axis=0), corners_n.max(axis=0)
    inner = np.array([WIDTH, HEIGHT]) - 2 * EDGE
    need_n = float(np.max((high_n - low_n) / inner)) * inner[1]
    span_n = next((span_n for span_n in SPANS_N if span_n >= need_n), need_n)
    px_per_n = inner[1] / span_n
    middle = np.array([WIDTH, HEIGHT]) / 2
    corners = middle + px_per_n * (corners_n - (low_n + high_n) / 2) * [1, -1]
    total_n = float(np.linalg.norm(corners_n[-1]))
    arrows = [_arrow(a, b, robot_scene.FELT, px_per_n) for a, b in pairwise(corners)]
    arrows.append(_arrow(corners[0], corners[-1], robot_scene.RESULTANT, px_per_n))
    bar = (
        f"<path d='M8 {HEIGHT - 8} h{span_n / 5 * px_per_n:.1f}' stroke='currentColor' stroke-width='2'/>"
        f"<text x='8' y='{HEIGHT - 14}' font-size='11' fill='currentColor'>{span_n / 5:.3g} N</text>"
    )
    return (
        f"<div style='padding:.2em .6em;font-size:.85em'>Contact forces on the body, tail to head; resultant "
        f"{total_n:.1f} N</div><svg viewBox='0 0 {WIDTH} {HEIGHT}' width='100%'>{''.join(arrows)}{bar}</svg>"
    )


def push_point_table(control: ControlState | None) -> str:
    """Solved and measured force of each push-point, tail to head; empty when the controller solved for none."""
    if (
        control is None
        or not len(control.push_points) == len(control.desired_force_n) == len(control.measured_force_n) > 0
    ):
        return ""
    rows = "".join(
        f"<tr><td>{escape(point.obstacle or 'unnamed')}</td><td>{desired_force_n:.1f}</td>"
        f"<td>{'unknown' if measured_force_n is None else f'{measured_force_n:.1f}'}</td></tr>"
        for point, desired_force_n, measured_force_n in zip(
            control.push_points, control.desired_force_n, control.measured_force_n, strict=True
        )
    )
    head = "<tr><th>push-point</th><th>solved, N</th><th>measured, N</th></tr>"
    return f"<table style='padding:.2em .6em;font-size:.85em;text-align:left;width:100%'>{head}{rows}</table>"


def _arrow(a: robot_scene.Floats, b: robot_scene.Floats, color: robot_scene.Color, px_per_n: float) -> str:
    """From a to b in pixels, with its size in newtons."""
    length = float(np.linalg.norm(b - a))
    if length < 1.0:
        return ""
    along = (b - a) / length
    side = np.array([-along[1], along[0]])
    head = min(11.0, 0.6 * length)
    neck = b - head * along
    left, right = neck + 0.4 * head * side, neck - 0.4 * head * side
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (b, left, right))
    name_at = (a + b) / 2 + 20 * side
    name = (
        f"<text x='{name_at[0]:.1f}' y='{name_at[1] + 4:.1f}' font-size='11' text-anchor='middle' "
        f"fill='rgb{color}'>{length / px_per_n:.1f} N</text>"
    )
    return (
        f"<path d='M{a[0]:.1f} {a[1]:.1f} L{neck[0]:.1f} {neck[1]:.1f}' stroke='rgb{color}' stroke-width='3'/>"
        f"<polygon points='{points}' fill='rgb{color}'/>{name if length > NAMED_PX else ''}"
    )
