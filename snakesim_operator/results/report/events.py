"""What happened in a run: start, hand-overs, largest force, jam, stop; and the snapshots that are drawn of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from snakesim_operator.results.metrics.motion import measure_motion
from snakesim_operator.results.metrics.propulsion import find_propulsion_periods
from snakesim_operator.results.report.snapshots import Snapshot, balanced_snapshots, count_unmeasured, find_snapshot
from snakesim_operator.results.report.timeline import jam_bands
from snakesim_operator.results.report.verdict import stop_of
from snakesim_operator.results.report.view import nodes_xy_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.results.time_axis import end_s

MAX_HAND_OVERS_DRAWN = 4
MAX_HAND_OVERS_LISTED = 8
SETTLING_S = 0.6  # after a hand-over, in which the forces that belong to it appear
SIMULTANEOUS_S = 0.06  # control publishes its state twenty times a second
SAME_SHAPE_M = 0.008  # a body that moved less looks the same
SAME_TIME_S = 0.1


@dataclass(frozen=True)
class Event:
    """Something that is worth looking at. joint: the one that begins to propel."""

    time_s: float
    words: str
    joint: int | None = None


def find_events(record: RunRecord, summary: RunSummary) -> list[Event]:
    """Return all events of a run in order of time; none of a run without ticks."""
    if not len(record.time_s):
        return []
    events = [Event(0.0, "Start")]
    events += _hand_over_events(record)
    events += _largest_force_events(record)
    events += [Event(band.start_s, "Jam") for band in jam_bands(record)[:1]]
    motion = measure_motion(record)
    stop = stop_of(record, motion) if motion and summary.locomoting_fraction else None
    if stop is None:
        events.append(Event(end_s(record), "End"))
    else:
        events.append(Event(stop.at_s, "Stop"))
    return sorted(events, key=lambda event: event.time_s)


def _hand_over_events(record: RunRecord) -> list[Event]:
    names = [joint.name for joint in record.description.joints]
    events: list[Event] = []
    for number, period in enumerate(find_propulsion_periods(record)):
        name = names[period.joint]
        words = f"{name} begins to propel" if number == 0 else f"Hand-over to {name}"
        events.append(Event(period.start_s, words, period.joint))
    return events


def _largest_force_events(record: RunRecord) -> list[Event]:
    """Return the event of the largest contact force; empty without any contact."""
    forces_n = record.contact_peak_n
    if not np.nanmax(forces_n, initial=0.0) > 0:
        return []
    row = int(np.nanargmax(forces_n))
    at_s = float(record.time_s[row] - record.time_s[0])
    return [Event(at_s, f"Largest contact force over 50 ms, {forces_n[row]:.0f} N")]


def select_listed(events: list[Event]) -> list[Event]:
    """Return the events that get a button: all but the hand-overs beyond MAX_HAND_OVERS_LISTED, except the last."""
    hand_overs = [event for event in events if event.joint is not None]
    left_out = hand_overs[MAX_HAND_OVERS_LISTED:-1]
    return [event for event in events if event not in left_out]


def drawn_snapshots(record: RunRecord, events: list[Event]) -> list[tuple[Event, Snapshot]]:
    """Choose the events of a run that get a drawing, and the snapshot of the snake that is drawn for each.

    Only a few hand-overs are drawn. Events whose snapshots look the same share one drawing with the words of both.

    Args:
        record: The recorded run.
        events: All events of the run.

    Returns:
        Pairs of event and snapshot, in order of the snapshots' time.
    """
    hand_over_times_s = _hand_over_times_to_draw(events)
    chosen: list[tuple[Event, Snapshot]] = []
    hand_overs_first = sorted(events, key=lambda event: event.joint is None)  # snapshots of hand-overs show forces
    for event in hand_overs_first:
        is_hand_over = event.joint is not None
        if is_hand_over and event.time_s not in hand_over_times_s:
            continue
        snapshot = _snapshot_of_event(record, event)
        if snapshot is None:
            continue
        delay_s = snapshot.time_s - event.time_s
        if delay_s > SIMULTANEOUS_S:
            event = replace(event, words=f"{event.words}, {delay_s:.2f} s later")

        similar_index = _find_similar(record, snapshot, chosen)
        if similar_index is None:
            chosen.append((event, snapshot))
            continue
        similar_event, similar_snapshot = chosen[similar_index]
        in_order = sorted((event, similar_event), key=lambda item: item.time_s)
        words = "; ".join(item.words for item in in_order)
        chosen[similar_index] = (replace(similar_event, words=words), similar_snapshot)
    return sorted(chosen, key=lambda pair: pair[1].time_s)


def _hand_over_times_to_draw(events: Sequence[Event]) -> set[float]:
    """Return the times of a few hand-overs, evenly chosen."""
    hand_overs = [event for event in events if event.joint is not None]
    count = min(len(hand_overs), MAX_HAND_OVERS_DRAWN)
    numbers = np.linspace(0, len(hand_overs) - 1, count).astype(int)
    return {hand_overs[number].time_s for number in numbers}


def _snapshot_of_event(record: RunRecord, event: Event) -> Snapshot | None:
    """Return the snapshot that is drawn for an event, or None if the record has none.

    Snapshots in which the controller's desired forces balance are preferred: first those with the fewest forces that
    were not measured, then the nearest in time. After a hand-over the new forces settle, so its snapshot may come up to
    SETTLING_S later. Without a balanced snapshot the one at the time of the event is used, which shows no forces.

    Args:
        record: What was recorded of the run.
        event: The event; a hand-over has the joint that propels from then on.
    """
    if event.joint is None:
        begin_s = event.time_s - SIMULTANEOUS_S
        end_s = event.time_s + SIMULTANEOUS_S
    else:
        begin_s = event.time_s
        end_s = event.time_s + SETTLING_S
    candidates: list[Snapshot] = []
    for snapshot in balanced_snapshots(record, begin_s, end_s):
        if event.joint is None or event.joint == snapshot.propulsion_joint:
            candidates.append(snapshot)

    def rank(snapshot: Snapshot) -> tuple[int, float]:
        return count_unmeasured(snapshot), abs(snapshot.time_s - event.time_s)

    return min(candidates, key=rank, default=find_snapshot(record, event.time_s))


def _find_similar(record: RunRecord, snapshot: Snapshot, chosen: Sequence[tuple[Event, Snapshot]]) -> int | None:
    """Return the index of the first chosen snapshot that looks like this one."""
    for index, (_, other) in enumerate(chosen):
        if _looks_alike(record, snapshot, other):
            return index
    return None


def _looks_alike(record: RunRecord, a: Snapshot, b: Snapshot) -> bool:
    moved_m = np.abs(nodes_xy_w(record, a.row) - nodes_xy_w(record, b.row)).max()
    return bool(moved_m < SAME_SHAPE_M or abs(a.time_s - b.time_s) < SAME_TIME_S)
