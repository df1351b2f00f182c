"""Draws the charts of the report over time, each with its colors."""

from typing import Any

import numpy as np

from snakesim_operator.results.metrics.motion import MOVING_LABEL, STATIONARY_LABEL, find_stops
from snakesim_operator.results.metrics.propulsion import PropulsionInterval
from snakesim_operator.results.page.charts import (
    ChartBar,
    ChartLine,
    Floats,
    PlotlyDict,
    TimeMarker,
    make_bar_chart,
    make_joint_heatmap,
    make_line_chart,
)
from snakesim_operator.results.report.timeline import (
    TimelineSeries,
    compute_reference_rad,
    describe_state,
    find_jam_intervals,
    find_state_intervals,
    select_commanded_torque_nm,
)
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import SATURATION_RATIO, max_or_none
from snakesim_operator.results.time_axis import get_run_end_s, get_time_origin_s

MOTION_COLORS = {MOVING_LABEL: "--locomoting", STATIONARY_LABEL: "--notlocomoting"}
# Of the limit of the joint; a limit that the controller set below that is drawn.
LOWERED_FRACTION = 0.995


def mark_faults(record: RunRecord) -> list[TimeMarker]:
    """Return a marker for every fault of the run."""
    marks: list[TimeMarker] = []
    for fault in record.host.faults:
        time_s = fault.tick * record.config.period_ns * 1e-9 - get_time_origin_s(record)
        marks.append(TimeMarker(time_s, "", "--bad"))
    return marks


def get_joint_color(joint_index: int) -> str:
    """Return the CSS variable with the color of a joint, by its index."""
    return f"--joint-{joint_index}"


def draw_advance(record: RunRecord, moved: TimelineSeries) -> PlotlyDict:
    """Draw the advance of the body over time."""
    return _make_line_chart_of_run(
        record,
        "Advance over time",
        "advance, m",
        [ChartLine(moved.label, moved.time_s, moved.values)],
    )


def draw_states_and_propulsion(
    record: RunRecord, intervals: list[PropulsionInterval]
) -> PlotlyDict:
    """Draw bars over time: measured motion, reported states, jams, and each joint that propelled.

    Args:
        record: The recorded run.
        intervals: Intervals in which joints propelled.
    """
    joint_names = [joint.name for joint in record.description.joints]
    drawn: list[ChartBar] = []
    stop_intervals = find_stops(record)
    if stop_intervals is not None:
        for span in stop_intervals.all_intervals:
            drawn.append(
                ChartBar("motion", span.start_s, span.end_s, span.label, MOTION_COLORS[span.label])
            )
    for band in find_state_intervals(record):
        drawn.append(
            ChartBar(
                "control",
                band.start_s,
                band.end_s,
                describe_state(band.label),
                f"--{band.label.lower()}",
            )
        )
    for band in find_jam_intervals(record):
        drawn.append(ChartBar("jam", band.start_s, band.end_s, "jammed", "--bad"))
    rows_with_bars = {bar.row for bar in drawn}
    rows = [row for row in ("motion", "control", "jam") if row in rows_with_bars]

    for interval in intervals:
        name = joint_names[interval.joint_index]
        words = f"{interval.duration_s:.1f} s"
        drawn.append(
            ChartBar(
                name, interval.start_s, interval.end_s, words, get_joint_color(interval.joint_index)
            )
        )
    head_to_tail = sorted({interval.joint_index for interval in intervals}, reverse=True)
    rows += [joint_names[joint] for joint in head_to_tail]
    return make_bar_chart(
        "States and propulsion joint over time",
        rows,
        drawn,
        get_run_end_s(record),
        mark_faults(record),
    )


def draw_joint_angle(
    record: RunRecord, joint_index: int, intervals: list[PropulsionInterval]
) -> PlotlyDict:
    """Draw the measured angle of a joint and its reference (Fig. 12 of the paper), shaded while it propelled."""
    drawn = [
        _make_line(
            record, "measured", record.angle_rad[:, joint_index], get_joint_color(joint_index)
        ),
        _make_line(record, "reference", compute_reference_rad(record, joint_index), "--ink", "dot"),
    ]
    label = f"Angle of {record.description.joints[joint_index].name} over time"
    return _make_line_chart_of_run(
        record, label, "angle, rad", drawn, shades=_shade_propulsion(intervals, joint_index)
    )


def draw_joint_torque(
    record: RunRecord, joint_index: int, intervals: list[PropulsionInterval]
) -> PlotlyDict:
    """Draw the measured and the commanded torque of a joint, and the torque limits (Fig. 13 of the paper)."""
    limit_nm = record.description.joints[joint_index].torque_limit_nm
    controller_limit_nm = record.torque_limit_nm[:, joint_index]
    lowered_nm = np.where(
        controller_limit_nm < LOWERED_FRACTION * limit_nm, controller_limit_nm, np.nan
    )
    drawn = [
        _make_line(
            record, "measured", record.torque_nm[:, joint_index], get_joint_color(joint_index)
        ),
        _make_line(
            record, "commanded", select_commanded_torque_nm(record, joint_index), "--ink", "dot"
        ),
    ]
    if np.isfinite(lowered_nm).any():
        for signed_limit_nm in (lowered_nm, -lowered_nm):
            drawn.append(
                _make_line(
                    record, "limit set by the controller", signed_limit_nm, "--faint", "dot", 1.0
                )
            )
    label = f"Torque of {record.description.joints[joint_index].name} over time"
    levels = [(limit_nm, "limit of the joint"), (-limit_nm, "")]
    return _make_line_chart_of_run(
        record,
        label,
        "torque, N·m",
        drawn,
        levels=levels,
        shades=_shade_propulsion(intervals, joint_index),
    )


def draw_torque_map(record: RunRecord, intervals: list[PropulsionInterval]) -> PlotlyDict:
    """Draw the torque of every joint as a heatmap (Fig. 11 of the paper), with frames around propulsion."""
    names = [joint.name for joint in record.description.joints]
    frames = [(one.start_s, one.end_s, one.joint_index) for one in intervals]
    full_nm = find_full_color_torque_nm(record)
    return make_joint_heatmap(
        "Torque of every joint over time",
        names,
        record.torque_nm,
        "N·m",
        full_nm,
        get_run_end_s(record),
        frames=frames,
    )


def find_full_color_torque_nm(record: RunRecord) -> float:
    """Return the torque in N·m that is drawn in full color: the maximum of the run, unless that is negligible."""
    min_full_nm = 0.05 * max(joint.torque_limit_nm for joint in record.description.joints)
    return max(max_or_none(np.abs(record.torque_nm)) or 0.0, min_full_nm, 1e-9)


def draw_max_torque_ratio(record: RunRecord) -> PlotlyDict:
    """Draw the largest ratio of torque to torque limit of all joints, with the ticks at the limit in red."""
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    percent = 100 * np.fmax.reduce(np.abs(record.torque_nm) / limits, axis=1)
    drawn = [_make_line(record, "largest of any joint", percent)]
    at_limit = percent >= 100 * SATURATION_RATIO
    if at_limit.any():
        drawn.append(
            _make_line(
                record, "at its limit", np.where(at_limit, percent, np.nan), "--bad", "solid", 3
            )
        )
    label = "Largest torque of any joint as a share of its limit"
    return _make_line_chart_of_run(
        record, label, "of limit, %", drawn, levels=[(100, "limit")], height=190
    )


def draw_contacts(record: RunRecord) -> list[PlotlyDict]:
    """Draw two charts: the strongest contact force, and the number of touched obstacles."""
    force = [_make_line(record, "strongest contact", record.contact_peak_n, "--measured")]
    count = [
        _make_line(record, "obstacles touched", record.contact_count, "--measured", shape="hv")
    ]
    levels = [(3, "three carry it")]
    return [
        _make_line_chart_of_run(
            record,
            "Strongest contact force over time, mean over 50 ms",
            "force, N",
            force,
            height=190,
        ),
        _make_line_chart_of_run(
            record,
            "Obstacles touched over time",
            "touched",
            count,
            levels=levels,
            height=160,
            from_zero=True,
        ),
    ]


def _make_line(
    record: RunRecord, name: str, values: Floats, *style: Any, **more_style: Any
) -> ChartLine:
    return ChartLine(name, record.time_s - get_time_origin_s(record), values, *style, **more_style)


def _make_line_chart_of_run(
    record: RunRecord, label: str, axis: str, drawn: list[ChartLine], **chart_options: Any
) -> PlotlyDict:
    return make_line_chart(
        label, axis, drawn, get_run_end_s(record), markers=mark_faults(record), **chart_options
    )


def _shade_propulsion(intervals: list[PropulsionInterval], joint_index: int) -> list[ChartBar]:
    of_joint = [interval for interval in intervals if interval.joint_index == joint_index]
    return [
        ChartBar("", interval.start_s, interval.end_s, "", get_joint_color(joint_index))
        for interval in of_joint
    ]
