"""Finds when the body moved, from its measured center of mass. Reports of the controller are not used.

The body moves at a time if its center was displaced by MOVING_M or more within the last WINDOW_S. A body that undulates
in place does not move. The state, the moving fraction and the verdict of a run all use this measure.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.locomotion import MOVING_M, WINDOW_S
from snakesim_operator.results.metrics.advance import ForwardProgress
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import LabeledInterval, get_run_end_s, get_time_origin_s

MAX_REST_M = 0.4 * MOVING_M  # a body that stays within this distance of a position is at rest there
TIME_TOLERANCE_S = 1e-6  # times that differ by less are the same
STATIONARY_LABEL = "standing still"
MOVING_LABEL = "moving"


@dataclass(frozen=True)
class StopIntervals:
    """The intervals in which the body was stationary, on the time axis of the run."""

    stops: list[LabeledInterval]  # in time order
    run_end_s: float  # of the run

    @property
    def moving_fraction(self) -> float:
        """Fraction of the time in which the body moved."""
        if self.run_end_s <= 0:
            return 0.0
        stopped_s = sum(stop.end_s - stop.start_s for stop in self.stops)
        return max(1.0 - stopped_s / self.run_end_s, 0.0)

    @property
    def final_stop(self) -> LabeledInterval | None:
        """The stop that lasted until the end; None if the body moved at the end."""
        if self.stops and self.stops[-1].end_s >= self.run_end_s:
            return self.stops[-1]
        return None

    @property
    def all_intervals(self) -> list[LabeledInterval]:
        """The stops and the intervals of motion between them, from the first tick to the end."""
        spans: list[LabeledInterval] = []
        covered_s = 0.0
        for stop in self.stops:
            if stop.start_s > covered_s:
                spans.append(LabeledInterval(covered_s, stop.start_s, MOVING_LABEL))
            spans.append(stop)
            covered_s = stop.end_s
        if covered_s < self.run_end_s:
            spans.append(LabeledInterval(covered_s, self.run_end_s, MOVING_LABEL))
        return spans

    def is_stationary_at(self, time_s: float) -> bool:
        """Return whether the body was stationary at a time on the axis."""
        return any(stop.start_s <= time_s <= stop.end_s for stop in self.stops)


def find_stops(record: RunRecord) -> StopIntervals | None:
    """Find the intervals in which the body was stationary, from the measured path of its center of mass.

    Args:
        record: The recorded run.

    Returns:
        The intervals, with times from the start of the time axis; None if the pose was never measured.
    """
    center_of_mass_path = _read_center_of_mass_path(record)
    if center_of_mass_path is None:
        return None
    time_s, center_w = center_of_mass_path
    run_end_s = get_run_end_s(record)
    is_stationary = _mask_stationary_samples(time_s, center_w)
    last_sample = len(is_stationary) - 1
    stops: list[LabeledInterval] = []
    for first, last in _find_true_segments(is_stationary):
        start_s = _find_stop_start_s(time_s, center_w, first)
        stop_end_s = run_end_s
        if last < last_sample:
            stop_end_s = _find_stop_end_s(time_s, center_w, last)
        # Motion for less than a window cannot be distinguished from a stop: merge the stops before and after it.
        if stops and start_s - stops[-1].end_s < WINDOW_S:
            previous = stops.pop()
            start_s = previous.start_s
        stops.append(LabeledInterval(start_s, max(stop_end_s, start_s), STATIONARY_LABEL))
    return StopIntervals(stops, run_end_s)


def _read_center_of_mass_path(record: RunRecord) -> tuple[Floats, Floats] | None:
    """Read the measured path of the body's center of mass.

    The poses of the pose sensor are used if the record has any; otherwise the poses that guidance published. Poses that
    guidance estimated by dead reckoning are left out, because they are not measurements.

    Returns:
        None if fewer than two poses were measured; otherwise a pair of

        time_s: (m,) times from the start of the time axis, in s.
        center_w: (m, 2) positions of the center of mass in the world, in m.
    """
    # The record has a pose sensor: its path is also that of the forward progress.
    progress = ForwardProgress.from_run(record)
    if progress is not None:
        return progress.time_s, progress.center_w
    time_origin_s = get_time_origin_s(record)
    samples: list[tuple[float, float, float]] = []
    for world in record.worlds:  # world models, with the pose that guidance used
        time_s = world.timestamp_ns * 1e-9
        if time_s < time_origin_s or world.pose_from != "sensor" or world.center_w is None:
            continue
        x, y = world.center_w[:2]
        samples.append((time_s - time_origin_s, x, y))
    if len(samples) < 2:
        return None
    samples_array = np.array(samples)  # (m, 3): time, x, y
    return samples_array[:, 0], samples_array[:, 1:]


def _find_window_starts(time_s: Floats) -> NDArray[np.intp]:
    """Return for each sample the first sample of the window that ends with it, (m,)."""
    return np.searchsorted(time_s, time_s - WINDOW_S - TIME_TOLERANCE_S)


def _mask_stationary_samples(time_s: Floats, center_w: Floats) -> NDArray[np.bool_]:
    """Return whether the center was displaced by less than MOVING_M in the window that ends with each sample, (m,).

    All samples of the first window get one value, so that a body that starts to move at once has moved from the start.
    """
    window_starts = _find_window_starts(time_s)
    displaced_m = np.hypot(*(center_w - center_w[window_starts]).T)
    is_stationary = displaced_m < MOVING_M
    after_first_window = np.flatnonzero(time_s >= time_s[0] + WINDOW_S - TIME_TOLERANCE_S)
    if len(after_first_window):
        first = after_first_window[0]
        is_stationary[:first] = is_stationary[first]
    else:  # the run is shorter than a window
        window_fraction = (time_s[-1] - time_s[0]) / WINDOW_S
        is_stationary[:] = displaced_m[-1] < MOVING_M * window_fraction
    return is_stationary


def _find_true_segments(values: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and the last index of each segment of adjacent true values."""
    padded = np.concatenate([[False], values, [False]]).astype(int)
    edges = np.flatnonzero(np.diff(padded))
    return [
        (int(first), int(after) - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)
    ]


def _find_stop_start_s(time_s: Floats, center_w: Floats, first: int) -> float:
    """Return when the body came to rest, which is up to WINDOW_S before the first stationary sample."""
    if first == 0:
        return 0.0
    window_start = int(_find_window_starts(time_s)[first])
    distances_m = np.hypot(*(center_w[window_start : first + 1] - center_w[first]).T)
    rows_away = np.flatnonzero(distances_m > MAX_REST_M)
    if not len(rows_away):
        return float(time_s[window_start])
    return float(time_s[window_start + int(rows_away[-1]) + 1])


def _find_stop_end_s(time_s: Floats, center_w: Floats, last: int) -> float:
    """Return when the body began to move again, which is up to WINDOW_S before the last stationary sample."""
    window_start = int(_find_window_starts(time_s)[last])
    distances_m = np.hypot(*(center_w[window_start : last + 1] - center_w[window_start]).T)
    rows_away = np.flatnonzero(distances_m > MAX_REST_M)
    if not len(rows_away):
        return float(time_s[last])
    return float(time_s[window_start + int(rows_away[0])])
