"""Finds the events of a run (start, hand-overs, largest force, jam, stop) and selects the snapshots to draw."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from snakesim_operator.results.metrics.motion import find_stops
from snakesim_operator.results.metrics.propulsion import find_propulsion_periods
from snakesim_operator.results.report.snapshots import (
    RunSnapshot,
    count_unmeasured_contacts,
    find_snapshot,
    find_snapshots_with_force_balance,
)
from snakesim_operator.results.report.timeline import find_jam_intervals
from snakesim_operator.results.report.verdict import find_final_stop
from snakesim_operator.results.report.view import find_body_points_xy_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.sampling import choose_even_indices
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.results.time_axis import get_run_end_s

MAX_HAND_OVERS_DRAWN = 4
MAX_HAND_OVERS_LISTED = 8
SETTLING_S = 0.6  # after a hand-over the new forces take up to this long to appear
SIMULTANEOUS_S = 0.06  # control publishes its state twenty times a second
SAME_SHAPE_M = 0.008  # a body that moved less looks the same
SAME_TIME_S = 0.1


@dataclass(frozen=True)
class ReportEvent:
    """An event of a run that the report shows."""

    time_s: float
    description: str
    joint_index: int | None = None  # joint that begins to propel; None if the event is no hand-over


def find_events(record: RunRecord, summary: RunSummary) -> list[ReportEvent]:
    """Find all events of a run, in order of time; none in a run without ticks."""
    if not len(record.time_s):
        return []
    events = [ReportEvent(0.0, "Start")]
    events += _find_hand_over_events(record)
    events += _find_largest_force_events(record)
    events += [ReportEvent(band.start_s, "Jam") for band in find_jam_intervals(record)[:1]]
    stop_intervals = find_stops(record)
    stop = (
        find_final_stop(record, stop_intervals)
        if stop_intervals and summary.locomoting_fraction
        else None
    )
    if stop is None:
        events.append(ReportEvent(get_run_end_s(record), "End"))
    else:
        events.append(ReportEvent(stop.time_s, "Stop"))
    return sorted(events, key=lambda event: event.time_s)


def _find_hand_over_events(record: RunRecord) -> list[ReportEvent]:
    names = [joint.name for joint in record.description.joints]
    events: list[ReportEvent] = []
    for number, period in enumerate(find_propulsion_periods(record)):
        name = names[period.joint_index]
        words = f"{name} begins to propel" if number == 0 else f"Hand-over to {name}"
        events.append(ReportEvent(period.start_s, words, period.joint_index))
    return events


def _find_largest_force_events(record: RunRecord) -> list[ReportEvent]:
    """Return the event of the largest contact force; none in a run without contact."""
    forces_n = record.contact_peak_n
    if not np.nanmax(forces_n, initial=0.0) > 0:
        return []
    row = int(np.nanargmax(forces_n))
    at_s = float(record.time_s[row] - record.time_s[0])
    return [ReportEvent(at_s, f"Largest contact force over 50 ms, {forces_n[row]:.0f} N")]


def select_listed_events(events: list[ReportEvent]) -> list[ReportEvent]:
    """Select the events that get a button: all except hand-overs between number MAX_HAND_OVERS_LISTED and the last."""
    hand_overs = [event for event in events if event.joint_index is not None]
    hidden_events = hand_overs[MAX_HAND_OVERS_LISTED:-1]
    return [event for event in events if event not in hidden_events]


def select_snapshots_to_draw(
    record: RunRecord, events: list[ReportEvent]
) -> list[tuple[ReportEvent, RunSnapshot]]:
    """Select the events of a run that get a drawing, and the snapshot of the snake that is drawn for each.

    Only a few hand-overs are drawn. Events whose snapshots look the same share one drawing with both descriptions.

    Args:
        record: The recorded run.
        events: All events of the run.

    Returns:
        Pairs of event and snapshot, in order of the snapshots' time.
    """
    hand_over_times_s = _hand_over_times_to_draw(events)
    drawn_events: list[tuple[ReportEvent, RunSnapshot]] = []
    # Their snapshots show forces, so others join them.
    hand_overs_first = sorted(events, key=lambda event: event.joint_index is None)
    for event in hand_overs_first:
        is_hand_over = event.joint_index is not None
        if is_hand_over and event.time_s not in hand_over_times_s:
            continue
        snapshot = _find_event_snapshot(record, event)
        if snapshot is None:
            continue
        delay_s = snapshot.time_s - event.time_s
        if delay_s > SIMULTANEOUS_S:
            event = replace(event, description=f"{event.description}, {delay_s:.2f} s later")

        similar_index = _find_similar_snapshot(record, snapshot, drawn_events)
        if similar_index is None:
            drawn_events.append((event, snapshot))
            continue
        similar_event, similar_snapshot = drawn_events[similar_index]
        in_order = sorted((event, similar_event), key=lambda item: item.time_s)
        words = "; ".join(item.description for item in in_order)
        drawn_events[similar_index] = (replace(similar_event, description=words), similar_snapshot)
    return sorted(drawn_events, key=lambda pair: pair[1].time_s)


def _hand_over_times_to_draw(events: Sequence[ReportEvent]) -> set[float]:
    """Return the times of at most MAX_HAND_OVERS_DRAWN hand-overs, evenly spaced in their order."""
    hand_overs = [event for event in events if event.joint_index is not None]
    indices = choose_even_indices(len(hand_overs), MAX_HAND_OVERS_DRAWN)
    return {hand_overs[index].time_s for index in indices}


def _find_event_snapshot(record: RunRecord, event: ReportEvent) -> RunSnapshot | None:
    """Find the snapshot that is drawn for an event; None if the pose is unknown.

    Snapshots in which the controller's desired forces balance are preferred: first those with the fewest forces that
    were not measured, then the nearest in time. After a hand-over the new forces settle, so its snapshot may come up to
    SETTLING_S later. Without a balanced snapshot the one at the time of the event is used, which shows no forces.

    Args:
        record: The recorded run.
        event: The event; a hand-over has the joint that propels from then on.
    """
    if event.joint_index is None:
        start_s = event.time_s - SIMULTANEOUS_S
        end_s = event.time_s + SIMULTANEOUS_S
    else:
        start_s = event.time_s
        end_s = event.time_s + SETTLING_S
    candidates: list[RunSnapshot] = []
    for snapshot in find_snapshots_with_force_balance(record, start_s, end_s):
        if event.joint_index is None or event.joint_index == snapshot.propulsion_joint:
            candidates.append(snapshot)

    def rank(snapshot: RunSnapshot) -> tuple[int, float]:
        return count_unmeasured_contacts(snapshot), abs(snapshot.time_s - event.time_s)

    return min(candidates, key=rank, default=find_snapshot(record, event.time_s))


def _find_similar_snapshot(
    record: RunRecord,
    snapshot: RunSnapshot,
    drawn_events: Sequence[tuple[ReportEvent, RunSnapshot]],
) -> int | None:
    """Return the index of the first drawn event whose snapshot looks like this one; None if there is none."""
    for index, (_, other) in enumerate(drawn_events):
        if _looks_alike(record, snapshot, other):
            return index
    return None


def _looks_alike(record: RunRecord, a: RunSnapshot, b: RunSnapshot) -> bool:
    """Return whether two snapshots have nearly the same body points, or nearly the same time."""
    moved_m = np.abs(
        find_body_points_xy_w(record, a.row) - find_body_points_xy_w(record, b.row)
    ).max()
    return bool(moved_m < SAME_SHAPE_M or abs(a.time_s - b.time_s) < SAME_TIME_S)
