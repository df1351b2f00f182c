"""Draws figures 8 to 13 of the SnakeSIM paper, for any run whose controller solved for contact forces.

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

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.figures.from_above import OBSTACLE_COLOR, plot_body, plot_obstacles
from snakesim_operator.features.figures.legends import place_legend_beside_title
from snakesim_operator.features.figures.lines import Floats, plot_over_time
from snakesim_operator.results.metrics.propulsion import (
    PropulsionInterval,
    find_propulsion_intervals,
)
from snakesim_operator.results.report.snapshots import (
    ForceBalance,
    RunSnapshot,
    find_snapshots_with_force_balance,
)
from snakesim_operator.results.report.timeline import (
    compute_reference_rad,
    find_most_propelling_joints,
    select_commanded_torque_nm,
)
from snakesim_operator.results.report.view import find_body_points_xy_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.sampling import choose_even_indices
from snakesim_operator.results.time_axis import get_run_end_s

MAX_SNAPSHOTS = 4  # in figure 10
MAX_JOINTS = 4  # in figures 12 and 13
MAX_ARROW_M = 0.25  # length of the largest force
LABEL_OFFSET_PT = (3, 3)
FORCE_FONT_SIZE = 6.5
TITLE_FONT_SIZE = 8.0

SOLVED_COLOR = "#c0392b"
COMMANDED_COLOR = "#2c6fbb"
MEASURED_COLOR = "#2c6fbb"
REFERENCE_COLOR = "#c0392b"

PlotSignal = Callable[[Axes, RunRecord, int], None]
"""Draws a signal of the joint with this index into the axes."""


def draw_paper_figures(
    record: RunRecord, width_in: float, span_s: tuple[float, float]
) -> dict[str, Figure]:
    """Draw figures 8 to 13 of the SnakeSIM paper for a run: its contact forces, joint angles and joint torques.

    The docstring of this module lists what each figure shows.

    Args:
        record: The recorded run.
        width_in: Width of a column of the paper in inches.
        span_s: Begin and end of the part of the run to draw, in s on the time axis.

    Returns:
        The figures by name, from "figure-8" to "figure-13".

    Raises:
        ConfigError: The recording has no contact forces that a controller solved for in this span.
    """
    snapshots_with_balance = find_snapshots_with_force_balance(record, *span_s)
    if not snapshots_with_balance:
        raise ConfigError(
            f"{record.path}: at no time within it did a controller report which forces it solved for; such are "
            "obstacle_triplet and obstacle_aided, with a pose and a recording; signals can be drawn of any run",
            code="recording/missing-data",
        )
    first_snapshot = snapshots_with_balance[0]
    selected_indices = choose_even_indices(len(snapshots_with_balance), MAX_SNAPSHOTS)
    selected_snapshots = [snapshots_with_balance[i] for i in selected_indices]
    intervals = find_propulsion_intervals(record)
    propelling_joints = find_most_propelling_joints(intervals, MAX_JOINTS)
    drawn_span_s = (span_s[0], min(span_s[1], get_run_end_s(record)))
    return {
        "figure-8": _draw_obstacle_triplet(record, first_snapshot, width_in),
        "figure-9": _draw_propelling_joint(record, first_snapshot, width_in),
        "figure-10": _draw_snapshots(record, selected_snapshots, width_in),
        "figure-11": _draw_all_torques(record, width_in, drawn_span_s),
        "figure-12": _draw_joint_signals(
            record, propelling_joints, intervals, width_in, drawn_span_s, _plot_angle
        ),
        "figure-13": _draw_joint_signals(
            record, propelling_joints, intervals, width_in, drawn_span_s, _plot_torque
        ),
    }


def _draw_obstacle_triplet(record: RunRecord, snapshot: RunSnapshot, width_in: float) -> Figure:
    """Draw body, obstacles and forces from above at the time of a snapshot."""
    figure = Figure((width_in, width_in))
    axes = figure.subplots()
    _plot_scene(axes, record, snapshot)
    _plot_forces(axes, _require_balance(snapshot))
    width_m = float(np.diff(axes.get_xlim())[0])
    height_m = float(np.diff(axes.get_ylim())[0])
    figure.set_figheight(width_in * min(height_m / width_m, 1.0) + 0.4)
    return figure


def _draw_propelling_joint(record: RunRecord, snapshot: RunSnapshot, width_in: float) -> Figure:
    """Draw figure 9: the joint whose torque presses on the last contact and so propels the robot, with its lever.

    Args:
        record: The recorded run.
        snapshot: The time to draw, with the joint and the force balance.
        width_in: Width of the figure in inches.
    """
    figure = Figure((width_in, 0.75 * width_in))
    axes = figure.subplots()
    balance = _require_balance(snapshot)
    _plot_scene(axes, record, snapshot)
    _plot_forces(axes, balance)
    contact_w = np.array(balance.contacts[-1].position_w[:2])
    shown_points_w = [contact_w]
    joint = snapshot.propulsion_joint
    if joint is not None:
        # The first of these points is the tail end.
        joint_w = find_body_points_xy_w(record, snapshot.row)[joint + 1]
        torque_nm = record.torque_nm[snapshot.row, joint]
        axes.plot(*joint_w, "o", color=rcParams["text.color"], markersize=5)
        axes.annotate(f"$\\tau$ {torque_nm:.2f} N·m", joint_w, (6, -12), textcoords="offset points")
        lever_w = np.column_stack([joint_w, contact_w])
        axes.plot(*lever_w, "--", color=rcParams["text.color"], linewidth=0.7)
        shown_points_w.append(joint_w)
    min_corner_w = np.min(shown_points_w, axis=0) - MAX_ARROW_M
    max_corner_w = np.max(shown_points_w, axis=0) + MAX_ARROW_M
    axes.set(xlim=(min_corner_w[0], max_corner_w[0]), ylim=(min_corner_w[1], max_corner_w[1]))
    return figure


def _draw_snapshots(record: RunRecord, snapshots: Sequence[RunSnapshot], width_in: float) -> Figure:
    """Draw a row for each moment: the scene from above, and the force polygon beside it."""
    figure = Figure((2 * width_in, 0.62 * width_in * len(snapshots)))
    rows = figure.subplots(len(snapshots), 2, width_ratios=(2, 1), squeeze=False)
    for (scene_axes, polygon_axes), snapshot, letter in zip(rows, snapshots, "abcd", strict=False):
        balance = _require_balance(snapshot)
        _plot_scene(scene_axes, record, snapshot)
        _plot_forces(scene_axes, balance)
        scene_axes.set_title(
            f"({letter}) {snapshot.time_s:.1f} s", loc="left", fontsize=TITLE_FONT_SIZE
        )
        _plot_force_polygon(polygon_axes, balance)
    return figure


def _draw_all_torques(record: RunRecord, width_in: float, span_s: tuple[float, float]) -> Figure:
    """Draw the torques of all joints over time, one above the other, at one scale."""
    names = [joint.name for joint in record.description.joints]
    figure = Figure((2 * width_in, 0.22 * len(names) + 0.6))
    axes = figure.subplots()
    max_torque_nm = float(np.nanmax(np.abs(record.torque_nm))) or 1.0
    for joint, torque_nm in enumerate(record.torque_nm.T):
        plot_over_time(axes, record, joint + 0.45 * torque_nm / max_torque_nm, color=MEASURED_COLOR)
        axes.axhline(joint, color=OBSTACLE_COLOR, linewidth=0.5, zorder=0)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlim(*span_s)
    axes.set(xlabel="time [s]", title=f"torque; a row's height is ±{max_torque_nm / 0.9:.1f} N·m")
    return figure


def _draw_joint_signals(
    record: RunRecord,
    joints: Sequence[int],
    intervals: Sequence[PropulsionInterval],
    width_in: float,
    span_s: tuple[float, float],
    plot_signal: PlotSignal,
) -> Figure:
    """Draw a signal of some joints over time, with an arrow over each interval in which the joint propelled.

    Args:
        record: The recorded run.
        joints: Indices of the joints, one for each pair of axes.
        intervals: Intervals of time in which joints propelled the robot.
        width_in: Width of the figure in inches.
        span_s: Begin and end of the part of the run to draw, in s on the time axis.
        plot_signal: Plots the signal of one joint into a pair of axes.
    """
    figure = Figure((width_in, 1.25 * len(joints) + 0.3))
    all_axes = figure.subplots(len(joints), 1, sharex=True, squeeze=False)[:, 0]
    for axes, joint, subfigure_letter in zip(all_axes, joints, "abcd", strict=False):
        plot_signal(axes, record, joint)
        top = axes.get_ylim()[1]
        for interval in intervals:
            if interval.joint_index != joint:
                continue
            axes.annotate(
                "",
                xy=(interval.end_s, top),
                xytext=(interval.start_s, top),
                arrowprops={"arrowstyle": "<->", "linewidth": 0.7},
                annotation_clip=False,
            )
        name = record.description.joints[joint].name
        axes.set_title(f"({subfigure_letter}) {name}", loc="left", fontsize=TITLE_FONT_SIZE)
    place_legend_beside_title(all_axes[0])
    all_axes[-1].set_xlim(*span_s)
    all_axes[-1].set_xlabel("time [s]")
    return figure


def _plot_angle(axes: Axes, record: RunRecord, joint_index: int) -> None:
    plot_over_time(axes, record, record.angle_rad[:, joint_index], "measured", color=MEASURED_COLOR)
    plot_over_time(
        axes,
        record,
        compute_reference_rad(record, joint_index),
        "reference",
        color=REFERENCE_COLOR,
        linestyle="--",
    )
    axes.set_ylabel("angle [rad]")


def _plot_torque(axes: Axes, record: RunRecord, joint_index: int) -> None:
    plot_over_time(axes, record, record.torque_nm[:, joint_index], "measured", color=MEASURED_COLOR)
    plot_over_time(
        axes,
        record,
        select_commanded_torque_nm(record, joint_index),
        "commanded",
        color=REFERENCE_COLOR,
        linestyle="--",
    )
    axes.set_ylabel("torque [N·m]")


def _plot_scene(axes: Axes, record: RunRecord, snapshot: RunSnapshot) -> None:
    """Plot obstacles and body to scale, and limit the axes to the surroundings of the body."""
    nodes_w = find_body_points_xy_w(record, snapshot.row)
    plot_obstacles(axes, record)
    plot_body(axes, record, nodes_w)
    axes.set_aspect("equal")
    low = nodes_w.min(axis=0) - MAX_ARROW_M
    high = nodes_w.max(axis=0) + MAX_ARROW_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")


def _plot_forces(axes: Axes, balance: ForceBalance) -> None:
    """Plot the contact forces f_i at their contacts, and the tether's force f_s at the first contact."""
    m_per_n = MAX_ARROW_M / max(*balance.magnitudes_n, balance.commanded_force_n)
    for i, contact in enumerate(balance.contacts):
        label = f"$f_{i + 1}$ {balance.magnitudes_n[i]:.1f} N"
        _plot_force(
            axes,
            contact.position_w[:2],
            m_per_n * np.asarray(balance.contact_forces_n[i]),
            label,
            SOLVED_COLOR,
        )
    label = f"$f_s$ {balance.commanded_force_n:.1f} N"
    first_w = balance.contacts[0].position_w[:2]
    _plot_force(axes, first_w, m_per_n * np.asarray(balance.tether_force_n), label, COMMANDED_COLOR)


def _plot_force(axes: Axes, start: Sequence[float], arrow: Floats, label: str, color: str) -> None:
    tip = np.array(start) + arrow
    _plot_arrow(axes, start, tip, color)
    axes.annotate(
        label,
        (tip[0], tip[1]),
        LABEL_OFFSET_PT,
        textcoords="offset points",
        fontsize=FORCE_FONT_SIZE,
        color=color,
    )


def _plot_force_polygon(axes: Axes, balance: ForceBalance) -> None:
    """Plot the forces in N as a polygon: the tether's force f_s, the contact forces f_i, and the resultant of the f_i.

    Args:
        axes: Axes to plot into.
        balance: Contact forces that the controller solved for, from tail to head.
    """
    corners_n = balance.corners_n
    contact_labels = [f"$f_{i + 1}$" for i in range(len(balance.contacts))]
    labels = ["$f_s$", *contact_labels]
    for i, label in enumerate(labels):
        start = corners_n[i]
        end = corners_n[i + 1]
        _plot_arrow(axes, start, end, COMMANDED_COLOR if i == 0 else SOLVED_COLOR)
        middle = (start + end) / 2
        axes.annotate(
            label, middle, LABEL_OFFSET_PT, textcoords="offset points", fontsize=FORCE_FONT_SIZE
        )
    _plot_arrow(axes, corners_n[1], corners_n[-1], rcParams["text.color"])
    min_corner_n = corners_n.min(axis=0)
    max_corner_n = corners_n.max(axis=0)
    margin_n = 0.15 * float(np.max(max_corner_n - min_corner_n))
    axes.set(
        xlim=(min_corner_n[0] - margin_n, max_corner_n[0] + margin_n),
        ylim=(min_corner_n[1] - margin_n, max_corner_n[1] + margin_n),
    )
    axes.set(xlabel="[N]")
    axes.set_aspect("equal")


def _plot_arrow(
    axes: Axes, start: Floats | Sequence[float], end: Floats | Sequence[float], color: str
) -> None:
    style = {
        "arrowstyle": "-|>",
        "color": color,
        "linewidth": 1.0,
        "shrinkA": 0,
        "shrinkB": 0,
        "mutation_scale": 7,
    }
    axes.annotate("", xy=(end[0], end[1]), xytext=(start[0], start[1]), arrowprops=style)


def _require_balance(snapshot: RunSnapshot) -> ForceBalance:
    """Return the forces of a snapshot for which the controller solved."""
    assert snapshot.force_balance is not None, "balanced snapshots have one"
    return snapshot.force_balance
