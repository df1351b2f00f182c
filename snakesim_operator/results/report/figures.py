"""The charts of the report: what is drawn over time, and in which color."""

from typing import Any

import numpy as np

from snakesim_operator.results.metrics.motion import MOVING, STANDING, measure_motion
from snakesim_operator.results.metrics.propulsion import Propulsion
from snakesim_operator.results.page.charts import Bar, Figure, Floats, Line, Mark, bars, joint_map, lines
from snakesim_operator.results.report.timeline import (
    Series,
    commanded_torque_nm,
    in_words,
    jam_bands,
    reference_rad,
    state_bands,
)
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import SATURATED_FROM, largest
from snakesim_operator.results.time_axis import end_s, zero_s

MOTION_COLORS = {MOVING: "--locomoting", STANDING: "--notlocomoting"}
LOWERED_FRACTION = 0.995  # of the joint's limit: a controller's own limit below that is drawn


def faults(record: RunRecord) -> list[Mark]:
    """Return a mark for every fault."""
    marks: list[Mark] = []
    for fault in record.host.faults:
        time_s = fault.tick * record.config.period_ns * 1e-9 - zero_s(record)
        marks.append(Mark(time_s, "", "--bad"))
    return marks


def color(joint: int) -> str:
    """Return the name of a joint's color."""
    return f"--joint-{joint}"


def advance(record: RunRecord, moved: Series) -> Figure:
    """Draw how far the body moved."""
    return _lines(record, "Advance over time", "advance, m", [Line(moved.what, moved.time_s, moved.value)])


def what_happened(record: RunRecord, intervals: list[Propulsion]) -> Figure:
    """Return a chart of bars over time: measured motion, reported states, jams, and each joint that propelled.

    Args:
        record: The recorded run.
        intervals: When which joint propelled.
    """
    joint_names = [joint.name for joint in record.description.joints]
    drawn: list[Bar] = []
    motion = measure_motion(record)
    if motion is not None:
        for span in motion.spans:
            drawn.append(Bar("motion", span.start_s, span.end_s, span.what, MOTION_COLORS[span.what]))
    for band in state_bands(record):
        drawn.append(Bar("control", band.start_s, band.end_s, in_words(band.what), f"--{band.what.lower()}"))
    for band in jam_bands(record):
        drawn.append(Bar("jam", band.start_s, band.end_s, "jammed", "--bad"))
    rows_with_bars = {bar.row for bar in drawn}
    rows = [row for row in ("motion", "control", "jam") if row in rows_with_bars]

    for interval in intervals:
        name = joint_names[interval.joint]
        words = f"{interval.duration_s:.1f} s"
        drawn.append(Bar(name, interval.start_s, interval.end_s, words, color(interval.joint)))
    head_to_tail = sorted({interval.joint for interval in intervals}, reverse=True)
    rows += [joint_names[joint] for joint in head_to_tail]
    return bars("States and propulsion joint over time", rows, drawn, end_s(record), faults(record))


def joint_angle(record: RunRecord, joint: int, intervals: list[Propulsion]) -> Figure:
    """Draw a joint's measured angle and its reference (paper, Fig. 12)."""
    drawn = [
        _line(record, "measured", record.angle_rad[:, joint], color(joint)),
        _line(record, "reference", reference_rad(record, joint), "--ink", "dot"),
    ]
    label = f"Angle of {record.description.joints[joint].name} over time"
    return _lines(record, label, "angle, rad", drawn, shades=_shades(intervals, joint))


def joint_torque(record: RunRecord, joint: int, intervals: list[Propulsion]) -> Figure:
    """Draw a joint's measured torque, the one commanded in torque mode, and the limits (paper, Fig. 13)."""
    limit_nm = record.description.joints[joint].torque_limit_nm
    controller_limit_nm = record.torque_limit_nm[:, joint]
    lowered_nm = np.where(controller_limit_nm < LOWERED_FRACTION * limit_nm, controller_limit_nm, np.nan)
    drawn = [
        _line(record, "measured", record.torque_nm[:, joint], color(joint)),
        _line(record, "commanded", commanded_torque_nm(record, joint), "--ink", "dot"),
    ]
    if np.isfinite(lowered_nm).any():
        for signed_limit_nm in (lowered_nm, -lowered_nm):
            drawn.append(_line(record, "limit set by the controller", signed_limit_nm, "--faint", "dot", 1.0))
    label = f"Torque of {record.description.joints[joint].name} over time"
    levels = [(limit_nm, "limit of the joint"), (-limit_nm, "")]
    return _lines(record, label, "torque, N·m", drawn, levels=levels, shades=_shades(intervals, joint))


def torque_map(record: RunRecord, intervals: list[Propulsion]) -> Figure:
    """Draw every joint's torque (paper, Fig. 11). Propulsion is framed."""
    names = [joint.name for joint in record.description.joints]
    frames = [(one.start_s, one.end_s, one.joint) for one in intervals]
    full_nm = full_color_nm(record)
    return joint_map(
        "Torque of every joint over time", names, record.torque_nm, "N·m", full_nm, end_s(record), frames=frames
    )


def full_color_nm(record: RunRecord) -> float:
    """Return the torque that is drawn in full color: the run's maximum, unless that is negligible."""
    min_full_nm = 0.05 * max(joint.torque_limit_nm for joint in record.description.joints)
    return max(largest(np.abs(record.torque_nm)) or 0.0, min_full_nm, 1e-9)


def torque_use(record: RunRecord) -> Figure:
    """Draw the hardest-worked joint's torque as a fraction of its limit. At the limit it is marked."""
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    percent = 100 * np.fmax.reduce(np.abs(record.torque_nm) / limits, axis=1)
    drawn = [_line(record, "largest of any joint", percent)]
    at_limit = percent >= 100 * SATURATED_FROM
    if at_limit.any():
        drawn.append(_line(record, "at its limit", np.where(at_limit, percent, np.nan), "--bad", "solid", 3))
    label = "Largest torque of any joint as a share of its limit"
    return _lines(record, label, "of limit, %", drawn, levels=[(100, "limit")], height=190)


def contacts(record: RunRecord) -> list[Figure]:
    """Draw the strongest contact, and how many obstacles are touched; three make a triplet."""
    force = [_line(record, "strongest contact", record.contact_peak_n, "--measured")]
    count = [_line(record, "obstacles touched", record.contact_count, "--measured", shape="hv")]
    levels = [(3, "three carry it")]
    return [
        _lines(record, "Strongest contact force over time, mean over 50 ms", "force, N", force, height=190),
        _lines(record, "Obstacles touched over time", "touched", count, levels=levels, height=160, from_zero=True),
    ]


def _line(record: RunRecord, name: str, values: Floats, *look: Any, **more: Any) -> Line:
    return Line(name, record.time_s - zero_s(record), values, *look, **more)


def _lines(record: RunRecord, label: str, axis: str, drawn: list[Line], **more: Any) -> Figure:
    return lines(label, axis, drawn, end_s(record), marks=faults(record), **more)


def _shades(intervals: list[Propulsion], joint: int) -> list[Bar]:
    of_joint = [interval for interval in intervals if interval.joint == joint]
    return [Bar("", interval.start_s, interval.end_s, "", color(joint)) for interval in of_joint]
