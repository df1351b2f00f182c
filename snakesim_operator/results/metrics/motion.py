"""When the body moved, by its measured center of mass, whatever the controller reported of it.

The body moves at a time if its center was displaced by MOVING_M or more within the last WINDOW_S. A body that wriggles
in place does not move. The state, the share of time and the verdict of a run all use this measure.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.locomotion import MOVING_M, WINDOW_S
from snakesim_operator.results.metrics.advance import Advance
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import Interval, end_s, zero_s

MAX_REST_M = 0.4 * MOVING_M  # a body that stays within this distance of its place has come to rest
ROUNDING_S = 1e-6  # times that differ by less are the same
STANDING = "standing still"
MOVING = "moving"


@dataclass(frozen=True)
class Motion:
    """The times in which the body was stationary, on the time axis of the run."""

    stops: list[Interval]  # in time order
    end_s: float  # of the run

    @property
    def moving_fraction(self) -> float:
        """Return the share of the time in which the body moved."""
        if self.end_s <= 0:
            return 0.0
        stopped_s = sum(stop.end_s - stop.start_s for stop in self.stops)
        return max(1.0 - stopped_s / self.end_s, 0.0)

    @property
    def final_stop(self) -> Interval | None:
        """Return the stop that lasted until the end, or None if the body moved at the end."""
        if self.stops and self.stops[-1].end_s >= self.end_s:
            return self.stops[-1]
        return None

    @property
    def spans(self) -> list[Interval]:
        """Return the stops and the intervals of motion between them, from the first tick to the end."""
        spans: list[Interval] = []
        covered_s = 0.0
        for stop in self.stops:
            if stop.start_s > covered_s:
                spans.append(Interval(covered_s, stop.start_s, MOVING))
            spans.append(stop)
            covered_s = stop.end_s
        if covered_s < self.end_s:
            spans.append(Interval(covered_s, self.end_s, MOVING))
        return spans

    def is_stationary_at(self, time_s: float) -> bool:
        """Return whether the body was stationary at a time on the axis."""
        return any(stop.start_s <= time_s <= stop.end_s for stop in self.stops)


def measure_motion(record: RunRecord) -> Motion | None:
    """Find the intervals in which the body was stationary, from the measured path of its center of mass.

    Args:
        record: The recorded run.

    Returns:
        The stops, with times from the start of the time axis; None if the pose was never measured.
    """
    measured = _read_center(record)
    if measured is None:
        return None
    time_s, center_w = measured
    run_end_s = end_s(record)
    is_stationary = _find_stationary(time_s, center_w)
    last_sample = len(is_stationary) - 1
    stops: list[Interval] = []
    for first, last in _find_runs(is_stationary):
        start_s = _find_stop_begin_s(time_s, center_w, first)
        stop_end_s = run_end_s
        if last < last_sample:
            stop_end_s = _find_stop_end_s(time_s, center_w, last)
        # Motion for less than a window cannot be distinguished from a stop: merge the stops before and after it.
        if stops and start_s - stops[-1].end_s < WINDOW_S:
            previous = stops.pop()
            start_s = previous.start_s
        stops.append(Interval(start_s, max(stop_end_s, start_s), STANDING))
    return Motion(stops, run_end_s)


def _read_center(record: RunRecord) -> tuple[Floats, Floats] | None:
    """Return the measured path of the body's center of mass.

    The pose sensor in the record is used if it has poses; otherwise the poses that guidance published. Poses that
    guidance estimated by dead reckoning are left out, because they are no measurement.

    Returns:
        time_s: (m,) times from the start of the time axis, in s.
        center_w: (m, 2) the center of mass in the world, in m.
        None if fewer than two poses were measured.
    """
    advance = Advance.from_run(record)
    if advance is not None:
        return advance.time_s, advance.center_w
    begin_s = zero_s(record)
    samples: list[tuple[float, float, float]] = []
    for world in record.worlds:
        time_s = world.timestamp_ns * 1e-9
        if time_s < begin_s or world.pose_from != "sensor" or world.center_w is None:
            continue
        x, y = world.center_w[:2]
        samples.append((time_s - begin_s, x, y))
    if len(samples) < 2:
        return None
    table = np.array(samples)  # (m, 3)
    return table[:, 0], table[:, 1:]


def _find_window_begins(time_s: Floats) -> NDArray[np.intp]:
    """Return for each sample the first sample of the window that ends with it, (m,)."""
    return np.searchsorted(time_s, time_s - WINDOW_S - ROUNDING_S)


def _find_stationary(time_s: Floats, center_w: Floats) -> NDArray[np.bool_]:
    """Return whether the center was displaced by less than MOVING_M in the window that ends with each sample, (m,).

    The first window is judged as a whole, so that a body that begins to move at once has moved from the beginning.
    """
    begins = _find_window_begins(time_s)
    displaced_m = np.hypot(*(center_w - center_w[begins]).T)
    is_stationary = displaced_m < MOVING_M
    behind_first_window = np.flatnonzero(time_s >= time_s[0] + WINDOW_S - ROUNDING_S)
    if len(behind_first_window):
        first = behind_first_window[0]
        is_stationary[:first] = is_stationary[first]
    else:  # the run is shorter than a window
        window_fraction = (time_s[-1] - time_s[0]) / WINDOW_S
        is_stationary[:] = displaced_m[-1] < MOVING_M * window_fraction
    return is_stationary


def _find_runs(values: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and the last index of each run of true values."""
    padded = np.concatenate([[False], values, [False]]).astype(int)
    edges = np.flatnonzero(np.diff(padded))
    return [(int(first), int(after) - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)]


def _find_stop_begin_s(time_s: Floats, center_w: Floats, first: int) -> float:
    """Return when the body came to rest, which is up to WINDOW_S before the first stationary sample."""
    if first == 0:
        return 0.0
    begin = int(_find_window_begins(time_s)[first])
    distances_m = np.hypot(*(center_w[begin : first + 1] - center_w[first]).T)
    away = np.flatnonzero(distances_m > MAX_REST_M)
    if not len(away):
        return float(time_s[begin])
    return float(time_s[begin + int(away[-1]) + 1])


def _find_stop_end_s(time_s: Floats, center_w: Floats, last: int) -> float:
    """Return when the body began to move again, which is up to WINDOW_S before the last stationary sample."""
    begin = int(_find_window_begins(time_s)[last])
    distances_m = np.hypot(*(center_w[begin : last + 1] - center_w[begin]).T)
    away = np.flatnonzero(distances_m > MAX_REST_M)
    if not len(away):
        return float(time_s[last])
    return float(time_s[begin + int(away[0])])
