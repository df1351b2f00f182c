"""The time axis of a run: seconds from its first tick; and what control reported on it."""

from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import ControlState
from snakesim_operator.results.run_log import RunRecord


@dataclass(frozen=True)
class Interval:
    """Something that held for a while."""

    start_s: float
    end_s: float
    what: str


def zero_s(record: RunRecord) -> float:
    """Return the robot's time at the first tick, where every time axis begins."""
    if len(record.time_s):
        return float(record.time_s[0])
    if record.control:
        return record.control[0].timestamp_ns * 1e-9
    return 0.0


def end_s(record: RunRecord) -> float:
    """Return the end of the last tick, on the time axis."""
    if len(record.time_s):
        return float(record.time_s[-1]) - zero_s(record) + record.config.period_ns * 1e-9
    if record.control:
        return record.control[-1].timestamp_ns * 1e-9 - zero_s(record)
    return 0.0


def reported_at_s(record: RunRecord, state: ControlState) -> float:
    """Return the time at which a state was reported, on the time axis and within the run."""
    return min(max(state.timestamp_ns * 1e-9 - zero_s(record), 0.0), end_s(record))


def reported_spans(record: RunRecord) -> list[tuple[float, float, ControlState]]:
    """Return (since, until, state) on the time axis: each state holds until the next is reported."""
    starts = [reported_at_s(record, state) for state in record.control]
    ends = [*starts, end_s(record)][1:]
    return list(zip(starts, ends, record.control, strict=True))


def merge_reports(record: RunRecord, values: Sequence[str | None]) -> list[Interval]:
    """Merge adjacent equal values into intervals.

    Args:
        record: What was recorded of the run.
        values: One value for each state that control reported; None: no interval.
    """
    bands: list[Interval] = []
    for (since, until, _), what in zip(reported_spans(record), values, strict=True):
        if what is None or until <= since:
            continue
        if bands and bands[-1].what == what and bands[-1].end_s >= since:
            bands[-1] = Interval(bands[-1].start_s, until, what)
        else:
            bands.append(Interval(since, until, what))
    return bands
