"""Draws a run from above, to scale: obstacles, the body at one time, and the paths of its ends."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scene_file.placement import outline_pipes
from snakesim_operator.results.report.top_view import find_outline_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.sampling import choose_even_indices
from snakesim_operator.results.time_axis import get_time_origin_s

BODY_COLOR = "#9aa5b1"
OBSTACLE_COLOR = "#d9dde2"
HEAD_COLOR = "#c0392b"
TAIL_COLOR = "#2c6fbb"
MAX_PATH_POINTS = 2000  # of a path; a run of many minutes has more ticks than a figure can show
MARGIN_M = 0.1  # around everything that is drawn
MIN_HEIGHT_IN = 1.2


def draw_head_and_tail_paths(
    record: RunRecord, width_in: float, span_s: tuple[float, float]
) -> Figure:
    """Draw the paths of head and tail, with the obstacles, and the body where it began and ended.

    Args:
        record: The run.
        width_in: Width of the figure in inches. The height follows from the paths.
        span_s: Begin and end of the part of the run to draw, in s on the time axis.

    Raises:
        ConfigError: The pose is unknown in this part of the run.
    """
    body_points_w = _sample_body_points_w(record, span_s)
    xy_w = body_points_w[:, :, :2]
    head_w = xy_w[:, -1]
    tail_w = xy_w[:, 0]
    min_corner_w = np.nanmin(xy_w, axis=(0, 1)) - MARGIN_M
    max_corner_w = np.nanmax(xy_w, axis=(0, 1)) + MARGIN_M
    width_m, height_m = max_corner_w - min_corner_w

    figure = Figure((width_in, max(width_in * float(height_m / width_m) + 0.5, MIN_HEIGHT_IN)))
    axes = figure.subplots()
    plot_obstacles(axes, record)
    plot_body(axes, record, xy_w[0], alpha=0.4)
    plot_body(axes, record, xy_w[-1])
    axes.plot(*tail_w.T, color=TAIL_COLOR, label="tail")
    axes.plot(*head_w.T, color=HEAD_COLOR, label="head")
    axes.set_aspect("equal")
    axes.set(
        xlim=(min_corner_w[0], max_corner_w[0]),
        ylim=(min_corner_w[1], max_corner_w[1]),
        xlabel="x [m]",
        ylabel="y [m]",
    )
    axes.locator_params(axis="y", nbins=4)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return figure


def _sample_body_points_w(record: RunRecord, span_s: tuple[float, float]) -> Floats:
    """Return tail end, joints and head end in the world at evenly chosen ticks, (n, joints + 2, 3).

    Args:
        record: The run.
        span_s: Begin and end of the part of the run, in s on the time axis.

    Raises:
        ConfigError: The pose is unknown in this part of the run.
    """
    start_s, end_s = span_s
    time_s = record.time_s - get_time_origin_s(record)
    rows = np.flatnonzero(record.has_pose & (time_s >= start_s) & (time_s <= end_s))
    sampled_rows = rows[choose_even_indices(len(rows), MAX_PATH_POINTS)]
    samples_w: list[Floats] = []
    for row in sampled_rows.tolist():
        body_points_w = record.find_body_points_w(row)
        if body_points_w is not None:
            samples_w.append(body_points_w)
    if not samples_w:
        raise ConfigError(
            f"{record.path}: the pose is unknown in this part of the run, so there is no path; a path needs a robot "
            "with a pose sensor; signals such as angle_rad can be drawn of any run",
            code="recording/missing-data",
        )
    return np.stack(samples_w)


def plot_obstacles(axes: Axes, record: RunRecord) -> None:
    """Plot all obstacles and pipes of a run to scale, seen from above."""
    for placed in [*outline_pipes(record.config.scene), *record.placed_obstacles]:
        obstacle = placed.obstacle
        if obstacle.shape == "box":
            axes.add_patch(Polygon(find_outline_w(obstacle), closed=True, color=OBSTACLE_COLOR))
        else:
            axes.add_patch(Circle(obstacle.position_w[:2], obstacle.radius_m, color=OBSTACLE_COLOR))


def plot_body(axes: Axes, record: RunRecord, body_points_w: Floats, *, alpha: float = 1.0) -> None:
    """Plot links and joints of a robot to scale, seen from above.

    Args:
        axes: Axes to plot into.
        record: The run, which has the radius of the links.
        body_points_w: (joints + 2, 2) tail end, joints and head end, m.
        alpha: Opacity; 1: opaque, 0: invisible.
    """
    joints_w = body_points_w[1:-1]
    for rear, front, link in zip(
        body_points_w[:-1], body_points_w[1:], record.description.links, strict=True
    ):
        length_m = max(float(np.hypot(*(front - rear))), 1e-9)
        along_link = (front - rear) / length_m
        half_width_w = link.radius_m * np.array([-along_link[1], along_link[0]])
        corners = [
            rear + half_width_w,
            front + half_width_w,
            front - half_width_w,
            rear - half_width_w,
        ]
        axes.add_patch(Polygon(corners, closed=True, color=BODY_COLOR, linewidth=0, alpha=alpha))
    for joint_w in joints_w:
        axes.add_patch(
            Circle(
                tuple(joint_w),
                record.description.links[0].radius_m,
                color=BODY_COLOR,
                linewidth=0,
                alpha=alpha,
            )
        )
    axes.plot(*joints_w.T, ".", color="white", markersize=2.0)
