"""Maps robot time and reports of control to the time axis of a run: seconds since its first tick."""

from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import ControlState
from snakesim_operator.results.run_log import RunRecord


def get_time_origin_s(record: RunRecord) -> float:
    """Return the robot time of the first tick in s, at which the time axis of the run begins."""
    if len(record.time_s):
        return float(record.time_s[0])
    if record.control_states:
        return record.control_states[0].timestamp_ns * 1e-9
    return 0.0


def get_run_end_s(record: RunRecord) -> float:
    """Return the end of the last tick on the time axis, which is the duration of the run in s."""
    if len(record.time_s):
        return float(record.time_s[-1]) - get_time_origin_s(record) + record.config.period_ns * 1e-9
    if record.control_states:
        return record.control_states[-1].timestamp_ns * 1e-9 - get_time_origin_s(record)
    return 0.0


@dataclass(frozen=True)
class LabeledInterval:
    """An interval of time with a label, such as a state."""

    start_s: float
    end_s: float
    label: str


def get_report_time_s(record: RunRecord, state: ControlState) -> float:
    """Return the time at which control reported a state, on the time axis, clipped to the run."""
    return min(
        max(state.timestamp_ns * 1e-9 - get_time_origin_s(record), 0.0), get_run_end_s(record)
    )


def list_control_state_spans(record: RunRecord) -> list[tuple[float, float, ControlState]]:
    """Return start, end and state of each report of control on the time axis: a state holds until the next report."""
    starts = [get_report_time_s(record, state) for state in record.control_states]
    ends = [*starts, get_run_end_s(record)][1:]
    return list(zip(starts, ends, record.control_states, strict=True))


def merge_equal_reports(record: RunRecord, values: Sequence[str | None]) -> list[LabeledInterval]:
    """Merge adjacent reports of control with equal values into intervals.

    Args:
        record: The recorded run.
        values: A label for each state that control reported; None if the report belongs to no interval.
    """
    intervals: list[LabeledInterval] = []
    for (start_s, end_s, _), label in zip(list_control_state_spans(record), values, strict=True):
        if label is None or end_s <= start_s:
            continue
        if intervals and intervals[-1].label == label and intervals[-1].end_s >= start_s:
            intervals[-1] = LabeledInterval(intervals[-1].start_s, end_s, label)
        else:
            intervals.append(LabeledInterval(start_s, end_s, label))
    return intervals
