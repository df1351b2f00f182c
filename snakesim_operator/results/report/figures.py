"""The charts of the report: what is drawn over time, and in which colour."""

import numpy as np

from snakesim_operator.results.page.charts import Bar, Figure, Line, Mark, bars, joint_map, lines
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.timeline import (
    Propulsion,
    Series,
    commanded_torque_nm,
    end_s,
    in_words,
    jam_bands,
    reference_rad,
    state_bands,
    zero_s,
)
from snakesim_operator.results.summary import SATURATED_FROM, largest

LOWERED = 0.995  # of the joint's limit: a controller's own limit below that is drawn


def faults(record: RunRecord) -> list[Mark]:
    """Every fault as a mark."""
    times_s = [fault.tick * record.config.period_ns * 1e-9 - zero_s(record) for fault in record.host.faults]
    return [Mark(time_s, "", "--bad") for time_s in times_s]


def colour(joint: int) -> str:
    """The joint's own."""
    return f"--joint-{joint}"


def advance(record: RunRecord, moved: Series) -> Figure:
    """How far it came."""
    line = Line(moved.what, moved.time_s, moved.value)
    return lines("Advance over time", "advance, m", [line], end_s(record), marks=faults(record))


def what_happened(record: RunRecord, intervals: list[Propulsion]) -> Figure:
    """States, jams, and a row for each joint that propelled."""
    drawn = [
        Bar("state", band.start_s, band.end_s, in_words(band.what), f"--{band.what.lower()}")
        for band in state_bands(record)
    ]
    drawn += [Bar("jam", band.start_s, band.end_s, "jammed", "--bad") for band in jam_bands(record)]
    names = [joint.name for joint in record.description.joints]
    drawn += [Bar(names[i.joint], i.start_s, i.end_s, f"{i.length_s:.1f} s", colour(i.joint)) for i in intervals]
    propelled = [names[joint] for joint in sorted({one.joint for one in intervals}, reverse=True)]
    rows = [row for row in ("state", "jam") if any(bar.row == row for bar in drawn)] + propelled
    return bars("States and propulsion joint over time", rows, drawn, end_s(record), faults(record))


def joint_angle(record: RunRecord, joint: int, intervals: list[Propulsion]) -> Figure:
    """Measured angle against its reference (paper, Fig. 12)."""
    time_s = record.time_s - zero_s(record)
    name = record.description.joints[joint].name
    drawn = [
        Line("measured", time_s, record.angle_rad[:, joint], colour(joint)),
        Line("reference", time_s, reference_rad(record, joint), "--ink", "dot"),
    ]
    return lines(
        f"Angle of {name} over time",
        "angle, rad",
        drawn,
        end_s(record),
        shades=_shades(intervals, joint),
        marks=faults(record),
    )


def joint_torque(record: RunRecord, joint: int, intervals: list[Propulsion]) -> Figure:
    """Measured torque, what torque mode asked for, and the limits (paper, Fig. 13)."""
    time_s = record.time_s - zero_s(record)
    limit = record.description.joints[joint].torque_limit_nm
    lowered = record.torque_limit_nm[:, joint]
    lowered = np.where(lowered < LOWERED * limit, lowered, np.nan)
    drawn = [
        Line("measured", time_s, record.torque_nm[:, joint], colour(joint)),
        Line("commanded", time_s, commanded_torque_nm(record, joint), "--ink", "dot"),
    ]
    if np.isfinite(lowered).any():
        drawn += [Line(f"limit set by the controller, {sign}", time_s, values, "--faint", "dot", 1.0)
                  for sign, values in (("+", lowered), ("−", -lowered))]  # fmt: skip
    return lines(
        f"Torque of {record.description.joints[joint].name} over time",
        "torque, N·m",
        drawn,
        end_s(record),
        levels=[(limit, "limit of the joint"), (-limit, "")],
        shades=_shades(intervals, joint),
        marks=faults(record),
    )


def torque_map(record: RunRecord, intervals: list[Propulsion]) -> Figure:
    """Every joint's torque (paper, Fig. 11); propulsion is framed."""
    names = [joint.name for joint in record.description.joints]
    frames = [(one.start_s, one.end_s, one.joint) for one in intervals]
    full_nm = full_colour_nm(record)
    return joint_map(
        "Torque of every joint over time", names, record.torque_nm, "N·m", full_nm, end_s(record), frames=frames
    )


def full_colour_nm(record: RunRecord) -> float:
    """The torque that is drawn in full colour: the run's largest, unless that is next to nothing."""
    least = 0.05 * max(joint.torque_limit_nm for joint in record.description.joints)
    return max(largest(np.abs(record.torque_nm)) or 0.0, least, 1e-9)


def torque_use(record: RunRecord) -> Figure:
    """The hardest-worked joint's torque as a share of its limit; at the limit it is marked."""
    time_s = record.time_s - zero_s(record)
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    share = 100 * np.fmax.reduce(np.abs(record.torque_nm) / limits, axis=1)
    drawn = [Line("largest of any joint", time_s, share)]
    at_limit = share >= 100 * SATURATED_FROM
    if at_limit.any():
        drawn.append(Line("at its limit", time_s, np.where(at_limit, share, np.nan), "--bad", width=3))
    label = "Largest torque of any joint as a share of its limit"
    return lines(label, "of limit, %", drawn, end_s(record), levels=[(100, "limit")], marks=faults(record), height=190)


def contacts(record: RunRecord) -> list[Figure]:
    """The strongest contact, and how many obstacles are touched; three make a triplet."""
    time_s = record.time_s - zero_s(record)
    force = Line("strongest contact", time_s, record.contact_peak_n, "--measured")
    count = Line("obstacles touched", time_s, record.contact_count, "--measured", shape="hv")
    return [
        lines(
            "Strongest contact force over time", "force, N", [force], end_s(record), marks=faults(record), height=190
        ),
        lines(
            "Obstacles touched over time",
            "touched",
            [count],
            end_s(record),
            levels=[(3, "three carry it")],
            height=160,
            from_zero=True,
        ),
    ]


def _shades(intervals: list[Propulsion], joint: int) -> list[Bar]:
    return [Bar("", one.start_s, one.end_s, "", colour(joint)) for one in intervals if one.joint == joint]
