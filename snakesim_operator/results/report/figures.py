"""The charts of the report, each made of the parts in `charts`."""

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report import charts
from snakesim_operator.results.report.charts import Frame
from snakesim_operator.results.report.palette import joint_class
from snakesim_operator.results.report.svg import element, line, text, text_width, title
from snakesim_operator.results.report.timeline import (
    Propulsion,
    Series,
    commanded_torque_nm,
    end_s,
    jam_bands,
    reference_rad,
    state_bands,
    zero_s,
)
from snakesim_operator.results.summary import largest

Floats = NDArray[np.float64]
LOWERED = 0.995  # of the joint's limit: a controller's own limit below that is drawn
Phase = tuple[float, float]  # from when to when, s
STEP = 19.0  # height of a joint's row in the hand-over staircase


def fault_times_s(record: RunRecord) -> list[float]:
    """When the faults came, on the time axis."""
    return [fault.tick * record.config.period_ns * 1e-9 - zero_s(record) for fault in record.host.faults]


def overview(record: RunRecord, moved: Series | None, intervals: list[Propulsion], width: float) -> str:
    """Distance over time, above it the states, below it the staircase of hand-overs; one time axis."""
    joints = sorted({one.joint for one in intervals}, reverse=True)
    end, band_top, band = end_s(record), 8.0, 20.0
    stairs = STEP * len(joints) + (12 if joints else 0)
    top = band_top + band + 10
    plot = 190.0 if moved is not None else 0.0
    height = top + plot + stairs + 36
    low, high = charts.range_of([moved.value], least=0.02, always=(0.0,)) if moved is not None else (0.0, 1.0)
    frame = Frame(width, height, end, low, high, left=66.0, top=top, bottom=36 + stairs)
    whole = Frame(width, height, end, 0, 1, left=66.0, top=top)
    parts = [charts.strip(frame, state_bands(record), band_top, band)]
    parts.append(charts.strip(frame, jam_bands(record), band_top + band, 5, named=False))
    if moved is not None:
        parts.append(charts.value_axis(frame, "advance, m"))
        for one in intervals:
            left, right = frame.x(one.start_s), frame.x(one.end_s)
            parts.append(
                element(
                    "rect", x=left, y=top, width=right - left, height=plot, class_=f"shade {joint_class(one.joint)}"
                )
            )
        parts.append(charts.curve(frame, moved.time_s, moved.value, "curve ink"))
    parts.append(_staircase(record, frame, joints, intervals, top + plot + 10))
    parts.append(charts.fault_marks(whole, fault_times_s(record)))
    parts.append(charts.time_axis(whole))
    return charts.chart(whole, "Advance, states and propulsion joint over time", *parts)


def _staircase(record: RunRecord, frame: Frame, joints: list[int], intervals: list[Propulsion], top: float) -> str:
    parts: list[str] = []
    for i, joint in enumerate(joints):
        name, y = record.description.joints[joint].name, top + STEP * i
        parts.append(text(frame.left - 7, y + STEP / 2 + 4, name, "small", anchor="end"))
        parts.append(line((frame.left, y + STEP / 2), (frame.width - frame.right, y + STEP / 2), "grid"))
        for one in intervals:
            if one.joint != joint:
                continue
            left, right = frame.x(one.start_s), frame.x(one.end_s)
            told = title(f"{name}, {one.start_s:.2f} to {one.end_s:.2f} s")
            bar = {"x": left, "y": y + 3, "width": max(right - left, 1.0), "height": STEP - 6}
            parts.append(element("rect", told, class_=f"stair {joint_class(joint)}", **bar))
            words = f"{one.length_s:.1f} s"
            if right - left > text_width(words, 11) + 6:
                parts.append(text((left + right) / 2, y + STEP / 2 + 4, words, "tiny on-colour", anchor="middle"))
    return "".join(parts)


def joint_angle(record: RunRecord, joint: int, intervals: list[Propulsion], phase_s: Phase, width: float) -> str:
    """Measured angle against its reference (paper, Fig. 12)."""
    time_s = record.time_s - zero_s(record)
    measured, reference = record.angle_rad[:, joint], reference_rad(record, joint)
    shown = (time_s >= phase_s[0]) & (time_s <= phase_s[1])
    low, high = charts.range_of([measured[shown], reference[shown]], least=0.05)
    high += 0.08 * (high - low)  # room for the arrows
    frame = Frame(width, 210, phase_s[1], low, high, begin_s=phase_s[0])
    return charts.chart(
        frame,
        f"Angle of {record.description.joints[joint].name} over time",
        charts.shades(frame, [one for one in intervals if one.joint == joint]),
        charts.axes(frame, "angle, rad"),
        charts.curve(frame, time_s, measured, "curve measured"),
        charts.curve(frame, time_s, reference, "curve reference"),
        charts.fault_marks(frame, fault_times_s(record)),
    )


def joint_torque(record: RunRecord, joint: int, intervals: list[Propulsion], phase_s: Phase, width: float) -> str:
    """Measured torque, what torque mode asked for, and the limits (paper, Fig. 13)."""
    time_s = record.time_s - zero_s(record)
    limit = record.description.joints[joint].torque_limit_nm
    measured, commanded = record.torque_nm[:, joint], commanded_torque_nm(record, joint)
    lowered = record.torque_limit_nm[:, joint]
    lowered = np.where(lowered < LOWERED * limit, lowered, np.nan)
    low, high = charts.range_of([measured, commanded], least=0.1, always=(-limit, limit))
    frame = Frame(width, 210, phase_s[1], low, high + 0.08 * (high - low), begin_s=phase_s[0])
    return charts.chart(
        frame,
        f"Torque of {record.description.joints[joint].name} over time",
        charts.shades(frame, [one for one in intervals if one.joint == joint]),
        charts.axes(frame, "torque, N·m"),
        charts.level(frame, limit, "limit"),
        charts.level(frame, -limit, "limit", "limit"),
        charts.curve(frame, time_s, lowered, "curve lowered"),
        charts.curve(frame, time_s, -lowered, "curve lowered"),
        charts.curve(frame, time_s, measured, "curve measured"),
        charts.curve(frame, time_s, commanded, "curve reference"),
        charts.fault_marks(frame, fault_times_s(record)),
    )


def torque_use(record: RunRecord, width: float) -> str:
    """The hardest-worked joint's torque as a share of its limit; at the limit it is marked."""
    time_s = record.time_s - zero_s(record)
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    share = 100 * np.fmax.reduce(np.abs(record.torque_nm) / limits, axis=1)
    frame = Frame(width, 170, end_s(record), 0.0, max(largest(share) or 0.0, 100.0) * 1.12)
    return charts.chart(
        frame,
        "Largest torque of any joint as a share of its limit",
        charts.axes(frame, "of limit, %"),
        charts.level(frame, 100, "limit", "limit"),
        charts.curve(frame, time_s, share, "curve ink"),
        charts.curve(frame, time_s, np.where(share >= 99, share, np.nan), "curve saturated"),
        charts.fault_marks(frame, fault_times_s(record)),
    )


def contact_force(record: RunRecord, width: float) -> str:
    """The strongest contact over time."""
    time_s = record.time_s - zero_s(record)
    _, high = charts.range_of([record.contact_peak_n], least=1.0, always=(0.0,))
    frame = Frame(width, 170, end_s(record), 0.0, high)
    return charts.chart(
        frame,
        "Strongest contact force over time",
        charts.axes(frame, "peak force, N"),
        charts.curve(frame, time_s, record.contact_peak_n, "curve measured"),
        charts.fault_marks(frame, fault_times_s(record)),
    )


def contact_count(record: RunRecord, width: float) -> str:
    """How many obstacles are touched over time; three make a triplet."""
    time_s = record.time_s - zero_s(record)
    frame = Frame(width, 130, end_s(record), 0.0, max(largest(record.contact_count) or 0.0, 3.0) + 0.7)
    return charts.chart(
        frame,
        "Obstacles touched over time",
        charts.axes(frame, "touched"),
        charts.level(frame, 3, "limit", "three make a triplet"),
        charts.curve(frame, time_s, record.contact_count, "curve measured", steps=True),
    )
