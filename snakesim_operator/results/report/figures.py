"""The charts of the report: what is drawn over time, and in which color."""

from typing import Any

import numpy as np

from snakesim_operator.results.metrics.motion import MOVING, STANDING, motion_of
from snakesim_operator.results.metrics.propulsion import Propulsion
from snakesim_operator.results.page.charts import Bar, Figure, Floats, Line, Mark, bars, joint_map, lines
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.timeline import (
    Series,
    commanded_torque_nm,
    in_words,
    jam_bands,
    reference_rad,
    state_bands,
)
from snakesim_operator.results.summary import SATURATED_FROM, largest
from snakesim_operator.results.time_axis import end_s, zero_s

MOTION_COLORS = {MOVING: "--locomoting", STANDING: "--notlocomoting"}
LOWERED = 0.995  # of the joint's limit: a controller's own limit below that is drawn


def faults(record: RunRecord) -> list[Mark]:
    """Every fault as a mark."""
    times_s = [fault.tick * record.config.period_ns * 1e-9 - zero_s(record) for fault in record.host.faults]
    return [Mark(time_s, "", "--bad") for time_s in times_s]


def color(joint: int) -> str:
    """The joint's own."""
    return f"--joint-{joint}"


def advance(record: RunRecord, moved: Series) -> Figure:
    """How far it came."""
    return _lines(record, "Advance over time", "advance, m", [Line(moved.what, moved.time_s, moved.value)])


def what_happened(record: RunRecord, intervals: list[Propulsion]) -> Figure:
    """Measured motion, states that control reported, jams, and a row for each joint that propelled."""
    motion = motion_of(record)
    drawn = [
        Bar("motion", span.start_s, span.end_s, span.what, MOTION_COLORS[span.what])
        for span in (motion.spans if motion else [])
    ]
    drawn += [
        Bar("control", band.start_s, band.end_s, in_words(band.what), f"--{band.what.lower()}")
        for band in state_bands(record)
    ]
    drawn += [Bar("jam", band.start_s, band.end_s, "jammed", "--bad") for band in jam_bands(record)]
    names = [joint.name for joint in record.description.joints]
    drawn += [Bar(names[i.joint], i.start_s, i.end_s, f"{i.length_s:.1f} s", color(i.joint)) for i in intervals]
    propelled = [names[joint] for joint in sorted({one.joint for one in intervals}, reverse=True)]
    rows = [row for row in ("motion", "control", "jam") if any(bar.row == row for bar in drawn)] + propelled
    return bars("States and propulsion joint over time", rows, drawn, end_s(record), faults(record))


def joint_angle(record: RunRecord, joint: int, intervals: list[Propulsion]) -> Figure:
    """Measured angle against its reference (paper, Fig. 12)."""
    drawn = [
        _line(record, "measured", record.angle_rad[:, joint], color(joint)),
        _line(record, "reference", reference_rad(record, joint), "--ink", "dot"),
    ]
    label = f"Angle of {record.description.joints[joint].name} over time"
    return _lines(record, label, "angle, rad", drawn, shades=_shades(intervals, joint))


def joint_torque(record: RunRecord, joint: int, intervals: list[Propulsion]) -> Figure:
    """Measured torque, what torque mode asked for, and the limits (paper, Fig. 13)."""
    limit = record.description.joints[joint].torque_limit_nm
    lowered = record.torque_limit_nm[:, joint]
    lowered = np.where(lowered < LOWERED * limit, lowered, np.nan)
    drawn = [
        _line(record, "measured", record.torque_nm[:, joint], color(joint)),
        _line(record, "commanded", commanded_torque_nm(record, joint), "--ink", "dot"),
    ]
    if np.isfinite(lowered).any():
        for one in (lowered, -lowered):
            drawn.append(_line(record, "limit set by the controller", one, "--faint", "dot", 1.0))
    label = f"Torque of {record.description.joints[joint].name} over time"
    levels = [(limit, "limit of the joint"), (-limit, "")]
    return _lines(record, label, "torque, N·m", drawn, levels=levels, shades=_shades(intervals, joint))


def torque_map(record: RunRecord, intervals: list[Propulsion]) -> Figure:
    """Every joint's torque (paper, Fig. 11); propulsion is framed."""
    names = [joint.name for joint in record.description.joints]
    frames = [(one.start_s, one.end_s, one.joint) for one in intervals]
    full_nm = full_color_nm(record)
    return joint_map(
        "Torque of every joint over time", names, record.torque_nm, "N·m", full_nm, end_s(record), frames=frames
    )


def full_color_nm(record: RunRecord) -> float:
    """The torque that is drawn in full color: the run's largest, unless that is next to nothing."""
    least = 0.05 * max(joint.torque_limit_nm for joint in record.description.joints)
    return max(largest(np.abs(record.torque_nm)) or 0.0, least, 1e-9)


def torque_use(record: RunRecord) -> Figure:
    """The hardest-worked joint's torque as a share of its limit; at the limit it is marked."""
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    share = 100 * np.fmax.reduce(np.abs(record.torque_nm) / limits, axis=1)
    drawn, at_limit = [_line(record, "largest of any joint", share)], share >= 100 * SATURATED_FROM
    if at_limit.any():
        drawn.append(_line(record, "at its limit", np.where(at_limit, share, np.nan), "--bad", "solid", 3))
    label = "Largest torque of any joint as a share of its limit"
    return _lines(record, label, "of limit, %", drawn, levels=[(100, "limit")], height=190)


def contacts(record: RunRecord) -> list[Figure]:
    """The strongest contact, and how many obstacles are touched; three make a triplet."""
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
    return [Bar("", one.start_s, one.end_s, "", color(joint)) for one in intervals if one.joint == joint]
