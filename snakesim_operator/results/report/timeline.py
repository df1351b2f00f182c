"""Time series of a record: states, propulsion intervals, references, distance; all from the first tick on."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from snakesim_hal.arrays import Floats
from snakesim_hal.wire.messages import ControlState, Mode
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.summary import arc_position_m

POSE_SAMPLES = 400
STATES = {"Locomoting": "moving as meant", "NotLocomoting": "not moving", "Idle": "idle", "PowerOff": "power off"}


@dataclass(frozen=True)
class Interval:
    """Something that held for a while."""

    start_s: float
    end_s: float
    what: str


@dataclass(frozen=True)
class Propulsion:
    """A joint propelled for a while."""

    start_s: float
    end_s: float
    joint: int

    @property
    def length_s(self) -> float:
        """How long."""
        return self.end_s - self.start_s


@dataclass(frozen=True)
class Series:
    """Values over time, and what they are."""

    time_s: Floats
    value: Floats
    what: str


def in_words(state: str) -> str:
    """A state of locomotion, for people."""
    return STATES.get(state, state)


def zero_s(record: RunRecord) -> float:
    """The robot's time at the first tick: where every time axis begins."""
    if len(record.time_s):
        return float(record.time_s[0])
    return record.control[0].stamp_ns * 1e-9 if record.control else 0.0


def end_s(record: RunRecord) -> float:
    """The end of the last tick, on the time axis."""
    if len(record.time_s):
        return float(record.time_s[-1]) - zero_s(record) + record.config.period_ns * 1e-9
    return record.control[-1].stamp_ns * 1e-9 - zero_s(record) if record.control else 0.0


def reported_at_s(record: RunRecord, state: ControlState) -> float:
    """When a state was reported, on the time axis and within the run."""
    return min(max(state.stamp_ns * 1e-9 - zero_s(record), 0.0), end_s(record))


def reported_spans(record: RunRecord) -> list[tuple[float, float, ControlState]]:
    """(since, until, state) on the time axis: each state holds until the next is reported."""
    starts = [reported_at_s(record, state) for state in record.control]
    return list(zip(starts, [*starts, end_s(record)][1:], record.control, strict=True))


def state_bands(record: RunRecord) -> list[Interval]:
    """Locomotion states; each holds until the next is reported."""
    return _merged(record, [state.state for state in record.control])


def jam_bands(record: RunRecord) -> list[Interval]:
    """When the controller said that the snake was jammed."""
    bands = _merged(record, ["jammed" if state.jammed else None for state in record.control])
    return [band for band in bands if band.what == "jammed"]


def propulsion_intervals(record: RunRecord) -> list[Propulsion]:
    """Which joint propelled when, in order of time."""
    joints = {joint.name: i for i, joint in enumerate(record.description.joints)}
    bands = _merged(record, [state.propulsion_joint for state in record.control])
    return [Propulsion(b.start_s, b.end_s, joints[b.what]) for b in bands if b.what in joints]


def hand_overs(record: RunRecord) -> list[Propulsion]:
    """Every time that another joint began to propel. One that pauses and goes on is none."""
    found: list[Propulsion] = []
    for one in propulsion_intervals(record):
        if not found or found[-1].joint != one.joint:
            found.append(one)
    return found


def joined(intervals: list[Propulsion], gap_s: float) -> list[Propulsion]:
    """Turns of one joint with less than a gap between them are one: no chart could show them apart."""
    found: list[Propulsion] = []
    newest: dict[int, int] = {}
    for one in intervals:
        i = newest.get(one.joint)
        if i is not None and one.start_s - found[i].end_s < gap_s:
            found[i] = Propulsion(found[i].start_s, one.end_s, one.joint)
        else:
            newest[one.joint] = len(found)
            found.append(one)
    return found


def most_used_joints(intervals: list[Propulsion], most: int = 6) -> list[int]:
    """The joints that propelled longest, head to tail as the hand-over goes."""
    spent: dict[int, float] = {}
    for interval in intervals:
        spent[interval.joint] = spent.get(interval.joint, 0.0) + interval.length_s
    longest = sorted(spent, key=lambda joint: -spent[joint])[:most]
    return sorted(longest, reverse=True)


def reference_rad(record: RunRecord, joint: int) -> Floats:
    """Where a joint was meant to be, (n,): its target in position mode, else what the controller said; NaN unknown."""
    reference = np.full(len(record.time_s), np.nan)
    states = [state for state in record.control if len(state.reference_rad) > joint]
    if states:
        stamps = np.array([state.stamp_ns * 1e-9 for state in states])
        angles = np.array([state.reference_rad[joint] for state in states])
        reference = np.interp(record.time_s, stamps, angles, left=np.nan, right=angles[-1])
    in_position = record.mode[:, joint] == Mode.POSITION
    return np.where(in_position, record.target[:, joint], reference)


def commanded_torque_nm(record: RunRecord, joint: int) -> Floats:
    """The torque that a joint was given in torque mode, (n,); NaN in every other mode."""
    return np.where(record.mode[:, joint] == Mode.TORQUE, record.target[:, joint], np.nan)


@lru_cache(maxsize=2)  # verdict, events and chart ask for it
def distance(record: RunRecord) -> Series | None:
    """Advance since the first tick: along the route, else of the tail as the controller knew it, else as it flies."""
    count = len(record.time_s)
    rows = np.unique(np.linspace(0, count - 1, min(count, POSE_SAMPLES)).astype(int)) if count else np.array([], int)
    rows = rows[record.posed[rows]]
    if len(rows) > 1:
        time_s = record.time_s[rows] - zero_s(record)
        arc = [arc_position_m(record, int(row)) for row in rows]
        if None not in arc:
            along = np.array(arc, dtype=np.float64)
            return Series(time_s, along - along[0], "advance along the route, mean over the body")
        moved = record.position_w[rows, :2] - record.position_w[rows[0], :2]
        return Series(time_s, np.hypot(*moved.T), "distance of the tail end from where it was")
    return reported_distance(record)


def came_to_rest_s(record: RunRecord, within_m: float) -> float | None:
    """Since when the body has stayed where it was at the end, on the time axis; None when nobody measured where."""
    moved = distance(record)
    if moved is None or not len(moved.value):
        return None
    away = np.flatnonzero(np.abs(moved.value - moved.value[-1]) > within_m)
    return float(moved.time_s[away[-1] + 1]) if len(away) else 0.0


def reported_distance(record: RunRecord) -> Series | None:
    """Advance of the tail since the controller first reported its place on the path."""
    states = [state for state in record.control if state.path_s_m is not None]
    if len(states) < 2:
        return None
    along = np.array([state.path_s_m for state in states], dtype=np.float64)
    stamps = np.array([reported_at_s(record, state) for state in states])
    return Series(stamps, along - along[0], "advance of the tail along the path, as the controller knew it")


def _merged(record: RunRecord, values: list[str | None]) -> list[Interval]:
    """Equal neighbours become one band; None is left out."""
    bands: list[Interval] = []
    for (since, until, _), what in zip(reported_spans(record), values, strict=True):
        if what is None or until <= since:
            continue
        if bands and bands[-1].what == what and bands[-1].end_s >= since:
            bands[-1] = Interval(bands[-1].start_s, until, what)
        else:
            bands.append(Interval(since, until, what))
    return bands
