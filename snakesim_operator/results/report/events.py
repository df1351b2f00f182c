"""What happened in a run: start, hand-overs, largest force, jam, stop; and the instants at which that is drawn."""

from dataclasses import dataclass, replace

import numpy as np

from snakesim_operator.results.metrics.motion import motion_of
from snakesim_operator.results.metrics.propulsion import propulsion_periods
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import Instant, balanced_instants, instant_at, unmeasured
from snakesim_operator.results.report.timeline import jam_bands
from snakesim_operator.results.report.verdict import stop_of
from snakesim_operator.results.report.view import nodes_xy_w
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.results.time_axis import end_s

HAND_OVERS_DRAWN, HAND_OVERS_LISTED = 4, 8
SETTLED_S = 0.6  # so soon after a hand-over the forces are drawn that belong to it
AT_ONCE_S = 0.06  # control publishes its state twenty times a second
SAME_M, SAME_S = 0.008, 0.1  # a body that moved less looks the same


@dataclass(frozen=True)
class Event:
    """Something worth a look. joint: the one that begins to propel."""

    time_s: float
    words: str
    joint: int | None = None


def events(record: RunRecord, summary: RunSummary) -> list[Event]:
    """All of them, in order of time; none of a run without ticks."""
    if not len(record.time_s):
        return []
    names = [joint.name for joint in record.description.joints]
    found = [Event(0.0, "Start")]
    for i, one in enumerate(propulsion_periods(record)):
        words = f"Hand-over to {names[one.joint]}" if i else f"{names[one.joint]} begins to propel"
        found.append(Event(one.start_s, words, one.joint))
    forces = record.contact_peak_n
    if np.nanmax(forces, initial=0.0) > 0:
        row = int(np.nanargmax(forces))
        at_s = float(record.time_s[row] - record.time_s[0])
        found.append(Event(at_s, f"Largest contact force over 50 ms, {forces[row]:.0f} N"))
    found += [Event(band.start_s, "Jam") for band in jam_bands(record)[:1]]
    motion = motion_of(record)
    stop = stop_of(record, motion) if motion and summary.locomoting_fraction else None
    found.append(Event(end_s(record), "End") if stop is None else Event(stop.at_s, "Stop"))
    return sorted(found, key=lambda one: one.time_s)


def listed(found: list[Event]) -> list[Event]:
    """All but hand-overs beyond a few: for buttons."""
    turns = [one for one in found if one.joint is not None]
    left_out = turns[HAND_OVERS_LISTED:-1]
    return [one for one in found if one not in left_out]


def drawn_instants(record: RunRecord, found: list[Event]) -> list[tuple[Event, Instant]]:
    """The events with the snake in each, of hand-overs a few; what looks the same is drawn once, under both names."""
    turns = [one for one in found if one.joint is not None]
    shown = {turns[i].time_s for i in np.linspace(0, len(turns) - 1, min(len(turns), HAND_OVERS_DRAWN)).astype(int)}
    chosen: list[tuple[Event, Instant]] = []
    for event in sorted(found, key=lambda one: one.joint is None):  # those with forces first
        if event.joint is not None and event.time_s not in shown:
            continue
        instant = _instant_of(record, event)
        if instant is None:
            continue
        later_s = instant.time_s - event.time_s
        if later_s > AT_ONCE_S:
            event = replace(event, words=f"{event.words}, {later_s:.2f} s later")
        alike = next((i for i, (_, other) in enumerate(chosen) if _look_alike(record, instant, other)), None)
        if alike is None:
            chosen.append((event, instant))
        else:
            other, drawn = chosen[alike]
            both = sorted((event, other), key=lambda one: one.time_s)
            chosen[alike] = replace(other, words="; ".join(one.words for one in both)), drawn
    return sorted(chosen, key=lambda pair: pair[1].time_s)


def _instant_of(record: RunRecord, event: Event) -> Instant | None:
    """With the forces of just then; of a hand-over, with those that came soon after and were felt."""
    before_s, after_s = (AT_ONCE_S, AT_ONCE_S) if event.joint is None else (0.0, SETTLED_S)
    near = balanced_instants(record, event.time_s - before_s, event.time_s + after_s)
    return min(
        [one for one in near if event.joint in (None, one.propulsion_joint)],
        key=lambda one: (unmeasured(one), abs(one.time_s - event.time_s)),
        default=instant_at(record, event.time_s),
    )


def _look_alike(record: RunRecord, a: Instant, b: Instant) -> bool:
    moved_m = np.abs(nodes_xy_w(record, a.row) - nodes_xy_w(record, b.row)).max()
    return bool(moved_m < SAME_M or abs(a.time_s - b.time_s) < SAME_S)
