"""Figures 8 to 13 of the SnakeSIM paper, of any run whose controller solved for contact forces.

8   the obstacle triplet: body, contacts, the forces that were solved for, and the tether's f_s
9   the joint that propels, its obstacle, the torque and the counter force, near
10  four moments of the run from above, with the force polygon of each
11  torque of every joint
12  angle of the joints that propelled, measured and reference; arrows where the joint propelled
13  torque of the same joints
"""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.figures.lines import Floats, over_time
from snakesim_operator.results.metrics.propulsion import Propulsion, propulsion_intervals
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import Balance, Instant, balanced_instants
from snakesim_operator.results.report.timeline import commanded_torque_nm, most_used_joints, reference_rad
from snakesim_operator.results.report.top_view import outline_w
from snakesim_operator.results.report.view import nodes_xy_w
from snakesim_operator.results.time_axis import end_s

MOMENTS = 4
ARROW_M = 0.25  # of the strongest force
BODY, OBSTACLE, SOLVED, COMMANDED = "#9aa5b1", "#d9dde2", "#c0392b", "#2c6fbb"
MEASURED, REFERENCE = "#2c6fbb", "#c0392b"


def figures(record: RunRecord, width_in: float, span_s: tuple[float, float]) -> dict[str, Figure]:
    """By name. Raises ConfigError for a run in which nothing was solved for."""
    instants = balanced_instants(record, *span_s)
    if not instants:
        raise ConfigError(
            f"{record.folder}: at no time within it did a controller say which forces it solved for; such are "
            "obstacle_triplet and obstacle_aided, with a pose and a recording; signals can be drawn of any run"
        )
    first = instants[0]
    moments = [instants[i] for i in np.unique(np.linspace(0, len(instants) - 1, MOMENTS).astype(int))]
    turns = propulsion_intervals(record)
    joints = most_used_joints(turns, 4)
    whole = (span_s[0], min(span_s[1], end_s(record)))
    return {
        "figure-8": _view(record, first, width_in),
        "figure-9": _near(record, first, width_in),
        "figure-10": _moments(record, moments, width_in),
        "figure-11": _torques(record, width_in, whole),
        "figure-12": _joints(record, joints, turns, width_in, whole, _angle),
        "figure-13": _joints(record, joints, turns, width_in, whole, _torque),
    }


def _view(record: RunRecord, instant: Instant, width_in: float) -> Figure:
    figure = Figure((width_in, width_in))
    axes = figure.subplots()
    _ground(axes, record, instant)
    _forces(axes, _solved(instant))
    across, tall = (float(np.diff(limits)[0]) for limits in (axes.get_xlim(), axes.get_ylim()))
    figure.set_figheight(width_in * min(tall / across, 1.0) + 0.4)
    return figure


def _near(record: RunRecord, instant: Instant, width_in: float) -> Figure:
    """Around the joint that propels: the last contact is that which its torque presses on."""
    figure = Figure((width_in, 0.75 * width_in))
    axes, balance = figure.subplots(), _solved(instant)
    _ground(axes, record, instant)
    _forces(axes, balance)
    contact = balance.contacts[-1]
    points = [np.array(contact.position_w[:2])]
    if (joint := instant.propulsion_joint) is not None:
        at = nodes_xy_w(record, instant.row)[joint + 1]
        torque_nm = record.torque_nm[instant.row, joint]
        axes.plot(*at, "o", color=rcParams["text.color"], markersize=5)
        axes.annotate(f"$\\tau$ {torque_nm:.2f} N·m", at, (6, -12), textcoords="offset points")
        axes.plot(*np.column_stack([at, points[0]]), "--", color=rcParams["text.color"], linewidth=0.7)
        points.append(at)
    low, high = np.min(points, axis=0) - ARROW_M, np.max(points, axis=0) + ARROW_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure


def _moments(record: RunRecord, moments: Sequence[Instant], width_in: float) -> Figure:
    figure = Figure((2 * width_in, 0.62 * width_in * len(moments)))
    rows = figure.subplots(len(moments), 2, width_ratios=(2, 1), squeeze=False)
    for (above, polygon), instant, letter in zip(rows, moments, "abcd", strict=False):
        _ground(above, record, instant)
        _forces(above, _solved(instant))
        above.set_title(f"({letter}) {instant.time_s:.1f} s", loc="left", fontsize=8.0)
        _polygon(polygon, _solved(instant))
    return figure


def _torques(record: RunRecord, width_in: float, span_s: tuple[float, float]) -> Figure:
    names = [joint.name for joint in record.description.joints]
    figure = Figure((2 * width_in, 0.22 * len(names) + 0.6))
    axes = figure.subplots()
    largest = float(np.nanmax(np.abs(record.torque_nm))) or 1.0
    for joint, values in enumerate(record.torque_nm.T):
        over_time(axes, record, joint + 0.45 * values / largest, color=MEASURED)
        axes.axhline(joint, color=OBSTACLE, linewidth=0.5, zorder=0)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlim(*span_s)
    axes.set(xlabel="time [s]", title=f"torque; a row's height is ±{largest / 0.9:.1f} N·m")
    return figure


def _joints(
    record: RunRecord,
    joints: Sequence[int],
    turns: Sequence[Propulsion],
    width_in: float,
    span_s: tuple[float, float],
    draw: Callable[[Axes, RunRecord, int], None],
) -> Figure:
    figure = Figure((width_in, 1.25 * len(joints) + 0.3))
    every = figure.subplots(len(joints), 1, sharex=True, squeeze=False)[:, 0]
    for axes, joint, letter in zip(every, joints, "abcd", strict=False):
        draw(axes, record, joint)
        top = axes.get_ylim()[1]
        for turn in (one for one in turns if one.joint == joint):
            ends = {"xy": (turn.end_s, top), "xytext": (turn.start_s, top)}
            axes.annotate("", **ends, arrowprops={"arrowstyle": "<->", "linewidth": 0.7}, annotation_clip=False)
        axes.set_title(f"({letter}) {record.description.joints[joint].name}", loc="left", fontsize=8.0)
    every[0].legend(loc="best")
    every[-1].set_xlim(*span_s)
    every[-1].set_xlabel("time [s]")
    return figure


def _angle(axes: Axes, record: RunRecord, joint: int) -> None:
    over_time(axes, record, record.angle_rad[:, joint], "measured", color=MEASURED)
    over_time(axes, record, reference_rad(record, joint), "reference", color=REFERENCE, linestyle="--")
    axes.set_ylabel("angle [rad]")


def _torque(axes: Axes, record: RunRecord, joint: int) -> None:
    over_time(axes, record, record.torque_nm[:, joint], "measured", color=MEASURED)
    over_time(axes, record, commanded_torque_nm(record, joint), "commanded", color=REFERENCE, linestyle="--")
    axes.set_ylabel("torque [N·m]")


def _ground(axes: Axes, record: RunRecord, instant: Instant) -> None:
    """Obstacles and body, to scale; the window is that round the body."""
    nodes = nodes_xy_w(record, instant.row)
    for item in record.placed:
        one = item.obstacle
        if one.shape == "box":
            axes.add_patch(Polygon(outline_w(one), closed=True, color=OBSTACLE))
        else:
            axes.add_patch(Circle(one.position_w[:2], one.radius_m, color=OBSTACLE))
    for a, b, link in zip(nodes[:-1], nodes[1:], record.description.links, strict=True):
        along = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
        aside = link.radius_m * np.array([-along[1], along[0]])
        axes.add_patch(Polygon([a + aside, b + aside, b - aside, a - aside], closed=True, color=BODY, linewidth=0))
    for joint in nodes[1:-1]:
        axes.add_patch(Circle(tuple(joint), record.description.links[0].radius_m, color=BODY, linewidth=0))
    axes.plot(*nodes[1:-1].T, ".", color="white", markersize=2.0)
    axes.set_aspect("equal")
    low, high = nodes.min(axis=0) - ARROW_M, nodes.max(axis=0) + ARROW_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")


def _forces(axes: Axes, balance: Balance) -> None:
    scale = ARROW_M / max(*balance.size_n, balance.commanded_n)
    solved = zip(balance.contacts, balance.contact_n, balance.size_n, strict=True)
    drawn = [
        (contact.position_w[:2], force, f"$f_{i + 1}$ {size:.1f} N", SOLVED)
        for i, (contact, force, size) in enumerate(solved)
    ]
    tether = f"$f_s$ {balance.commanded_n:.1f} N"
    drawn.append((balance.contacts[0].position_w[:2], balance.tether_n, tether, COMMANDED))
    for at, force, name, color in drawn:
        tip = np.array(at) + scale * np.asarray(force)
        _arrow(axes, at, tip, color)
        axes.annotate(name, (tip[0], tip[1]), (3, 3), textcoords="offset points", fontsize=6.5, color=color)


def _polygon(axes: Axes, balance: Balance) -> None:
    """f_s and the contact forces head to tail, in newtons, and their resultant."""
    corners = balance.corners_n
    names = ["$f_s$", *(f"$f_{i + 1}$" for i in range(len(balance.contacts)))]
    for i, (a, b, name) in enumerate(zip(corners[:-1], corners[1:], names, strict=True)):
        _arrow(axes, a, b, COMMANDED if i == 0 else SOLVED)
        axes.annotate(name, (a + b) / 2, (3, 3), textcoords="offset points", fontsize=6.5)
    _arrow(axes, corners[1], corners[-1], rcParams["text.color"])
    low, high = corners.min(axis=0), corners.max(axis=0)
    air = 0.15 * float(np.max(high - low))
    axes.set(xlim=(low[0] - air, high[0] + air), ylim=(low[1] - air, high[1] + air), xlabel="[N]")
    axes.set_aspect("equal")


def _arrow(axes: Axes, start: Floats | tuple[float, ...], end: Floats | tuple[float, ...], color: str) -> None:
    look = {"arrowstyle": "-|>", "color": color, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
    axes.annotate("", xy=tuple(end), xytext=tuple(start), arrowprops=look)


def _solved(instant: Instant) -> Balance:
    assert instant.balance is not None, "balanced instants have one"
    return instant.balance
