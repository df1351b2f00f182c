"""When the body moved, by its measured center of mass, whatever the controller reported of it.

It moves at a time if its center was displaced by MOVING_M or more within the last WINDOW_S. A body that wriggles in
place does not. State, share of time and sentence of a run are all made of this.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.locomotion import MOVING_M, WINDOW_S
from snakesim_operator.results.metrics.advance import Advance
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import Interval, end_s, zero_s

RESTING_M = 0.4 * MOVING_M  # so near to where it then stands, a body has come to rest
STANDING, MOVING = "standing still", "moving"


@dataclass(frozen=True)
class Motion:
    """Spans in which the body stood still, on the time axis of the run."""

    standing: list[Interval]
    end_s: float

    @property
    def moving_fraction(self) -> float:
        """Share of the time in which it moved."""
        if self.end_s <= 0:
            return 0.0
        stood_s = sum(one.end_s - one.start_s for one in self.standing)
        return max(1.0 - stood_s / self.end_s, 0.0)

    @property
    def final_stop(self) -> Interval | None:
        """The span in which it stood until the end; None when it moved to the end."""
        if self.standing and self.standing[-1].end_s >= self.end_s:
            return self.standing[-1]
        return None

    @property
    def spans(self) -> list[Interval]:
        """Standing and moving spans, from the first tick to the end."""
        found: list[Interval] = []
        at_s = 0.0
        for one in self.standing:
            if one.start_s > at_s:
                found.append(Interval(at_s, one.start_s, MOVING))
            found.append(one)
            at_s = one.end_s
        if at_s < self.end_s:
            found.append(Interval(at_s, self.end_s, MOVING))
        return found

    def stands_at(self, time_s: float) -> bool:
        """Whether it stood still at a time of the axis."""
        return any(one.start_s <= time_s <= one.end_s for one in self.standing)


def motion_of(record: RunRecord) -> Motion | None:
    """None when the pose was never measured: then it is unknown whether the body moved."""
    measured = _measured_centre(record)
    if measured is None:
        return None
    time_s, center_w = measured
    whole_s = end_s(record)
    stands = _stands(time_s, center_w)
    standing: list[Interval] = []
    for first, last in _runs(stands):
        start_s = _rest_begins_s(time_s, center_w, first)
        until_s = whole_s if last == len(stands) - 1 else _rest_ends_s(time_s, center_w, last)
        if standing and start_s - standing[-1].end_s < WINDOW_S:  # too short to have moved for a window in between
            start_s = standing.pop().start_s
        standing.append(Interval(start_s, max(until_s, start_s), STANDING))
    return Motion(standing, whole_s)


def _measured_centre(record: RunRecord) -> tuple[Floats, Floats] | None:
    """Times on the axis, (m,), and the center of mass then, (m, 2): by the pose sensor, else as guidance measured it.

    A pose that guidance estimated by dead reckoning is no measurement.
    """
    advance = Advance.of(record)
    if advance is not None:
        return advance.time_s, advance.center_w
    begin_s = zero_s(record)
    found = [
        (world.timestamp_ns * 1e-9 - begin_s, *world.center_w[:2])
        for world in record.worlds
        if world.center_w is not None and world.pose_from == "sensor" and world.timestamp_ns * 1e-9 >= begin_s
    ]
    if len(found) < 2:
        return None
    rows = np.array(found)
    return rows[:, 0], rows[:, 1:]


def _window_begins(time_s: Floats) -> NDArray[np.intp]:
    """(m,) for each sample the first sample of the window that ends with it."""
    return np.searchsorted(time_s, time_s - WINDOW_S - 1e-6)


def _stands(time_s: Floats, center_w: Floats) -> NDArray[np.bool_]:
    """(m,) whether the center was displaced by less than MOVING_M in the window that ends then.

    The first window is judged as a whole, so that a body that sets off at once has moved from the beginning.
    """
    begins = _window_begins(time_s)
    displaced_m = np.hypot(*(center_w - center_w[begins]).T)
    stands = displaced_m < MOVING_M
    whole = np.flatnonzero(time_s >= time_s[0] + WINDOW_S - 1e-6)
    if len(whole):
        stands[: whole[0]] = stands[whole[0]]
    else:  # a run of less than a window
        share = (time_s[-1] - time_s[0]) / WINDOW_S
        stands[:] = displaced_m[-1] < MOVING_M * share
    return stands


def _runs(stands: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last sample of each row of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stands, [False]]).astype(int)))
    return [(int(first), int(after) - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)]


def _rest_begins_s(time_s: Floats, center_w: Floats, first: int) -> float:
    """When it came to rest: the window that ends with the first standing sample began up to WINDOW_S earlier."""
    if first == 0:
        return 0.0
    begin = int(_window_begins(time_s)[first])
    away = np.flatnonzero(np.hypot(*(center_w[begin : first + 1] - center_w[first]).T) > RESTING_M)
    at = begin + int(away[-1]) + 1 if len(away) else begin
    return float(time_s[at])


def _rest_ends_s(time_s: Floats, center_w: Floats, last: int) -> float:
    """When it set off again: in the window that ends with the last standing sample it was still near its place."""
    begin = int(_window_begins(time_s)[last])
    away = np.flatnonzero(np.hypot(*(center_w[begin : last + 1] - center_w[begin]).T) > RESTING_M)
    return float(time_s[begin + int(away[0]) if len(away) else last])
