"""The table of an evaluation: for each condition and controller, how many trials reached the goal, and how."""

from collections.abc import Sequence

import numpy as np

from snakesim_operator.features.evaluate.condition_results import ConditionResults
from snakesim_operator.results.metrics.intervals import (
    compute_mean_interval,
    compute_wilson_interval,
)

UNKNOWN_TEXT = "–"
# Headings of the columns. "net": of trials without a goal, whose displacement from start to end counts, in any
# direction.
CONDITION = "condition"
CONTROLLER = "controller"
REACHED_GOAL = "reached goal"
SUCCESS_INTERVAL = "95 %"
ADVANCE_M = "m"
ADVANCE_INTERVAL_M = "95 % of m"
SPEED_M_S = "m/s"
ENERGY_J_PER_M = "J/m"
NET_M = "net m"
NET_INTERVAL_M = "95 % of net m"
NET_SPEED_M_S = "net m/s"
NET_ENERGY_J_PER_M = "net J/m"
STALLED_S = "stalled s"
DURATION_S = "time s"
ERRORS = "errors"
HEADINGS = (
    CONDITION,
    CONTROLLER,
    REACHED_GOAL,
    SUCCESS_INTERVAL,
    ADVANCE_M,
    ADVANCE_INTERVAL_M,
    SPEED_M_S,
    ENERGY_J_PER_M,
    NET_M,
    NET_INTERVAL_M,
    NET_SPEED_M_S,
    NET_ENERGY_J_PER_M,
    STALLED_S,
    DURATION_S,
    ERRORS,
)  # in the order of the table
NET_HEADINGS = (NET_M, NET_INTERVAL_M, NET_SPEED_M_S, NET_ENERGY_J_PER_M)
TEXT_COLUMN_COUNT = 2  # condition and controller: always shown, and aligned to the left


def format_table(results: Sequence[ConditionResults]) -> list[str]:
    """Return the table for a terminal.

    Speed, energy and time are medians of the trials that reached the goal. Other values are medians of all trials.
    """
    table = make_result_table(results)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines: list[str] = []
    for cells in table:
        padded: list[str] = []
        for column, (cell, width) in enumerate(zip(cells, widths, strict=True)):
            is_text = column < TEXT_COLUMN_COUNT
            padded.append(cell.ljust(width) if is_text else cell.rjust(width))
        lines.append("  ".join(padded).rstrip())
    return lines


def make_result_table(results: Sequence[ConditionResults]) -> list[list[str]]:
    """Return HEADINGS and the cells of each row, without the columns in which nothing is known."""
    table = [list(HEADINGS), *map(_format_cells, results)]
    shown_columns: list[int] = []
    for column in range(len(HEADINGS)):
        has_a_value = any(cells[column].strip(UNKNOWN_TEXT) for cells in table[1:])
        if column < TEXT_COLUMN_COUNT or has_a_value:
            shown_columns.append(column)
    return [[cells[column] for column in shown_columns] for cells in table]


def _format_cells(results: ConditionResults) -> list[str]:
    """Return the texts of one row, one for each heading in HEADINGS; some are UNKNOWN_TEXT.

    Distances and stalls are those of all trials. Speed, energy and time are those of the trials that reached their
    goal, or that had none. Each number is a median, but intervals are 95 % confidence intervals of means.
    """
    duration_metric = "goal_reached_s" if results.success_count else "duration_s"
    speeds_m_s = results.list_values("advance_m_s", successful_only=True)
    energies_j_per_m = results.list_values("energy_j_per_m", successful_only=True)
    durations_s = results.list_values(duration_metric, successful_only=True)
    text_by_heading = {
        CONDITION: results.condition_name,
        CONTROLLER: results.controller,
        REACHED_GOAL: _format_success_count(results),
        SUCCESS_INTERVAL: _format_success_interval(results),
        ADVANCE_M: _format_median(results.list_values("advance_m"), 2),
        ADVANCE_INTERVAL_M: _format_mean_interval(results, "advance_m"),
        SPEED_M_S: _format_median(speeds_m_s, 3),
        ENERGY_J_PER_M: _format_median(energies_j_per_m, 1),
        **_format_net_displacement_cells(results),
        STALLED_S: _format_median(results.list_values("stalled_s"), 1),
        DURATION_S: _format_median(durations_s, 1),
        ERRORS: str(results.error_count or ""),
    }
    return [text_by_heading[heading] for heading in HEADINGS]


def _format_success_count(results: ConditionResults) -> str:
    if results.success_count is None:
        return UNKNOWN_TEXT
    return f"{results.success_count}/{results.trial_count}"


def _format_success_interval(results: ConditionResults) -> str:
    if results.success_count is None:
        return UNKNOWN_TEXT
    low, high = compute_wilson_interval(results.success_count, results.trial_count)
    return f"{100 * low:.0f}-{100 * high:.0f}"


def _format_net_displacement_cells(results: ConditionResults) -> dict[str, str]:
    """Return the cells about the displacement from start to end, by heading.

    They are UNKNOWN_TEXT for trials with a goal, for which the advance towards the goal counts instead.
    """
    if results.success_count is not None:
        return dict.fromkeys(NET_HEADINGS, UNKNOWN_TEXT)
    return {
        NET_M: _format_median(results.list_values("net_displacement_m"), 2),
        NET_INTERVAL_M: _format_mean_interval(results, "net_displacement_m"),
        NET_SPEED_M_S: _format_median(results.list_values("displacement_m_s"), 3),
        NET_ENERGY_J_PER_M: _format_median(results.list_values("displacement_energy_j_per_m"), 1),
    }


def _format_mean_interval(results: ConditionResults, metric: str) -> str:
    """Return the interval of a mean; with a goal, the success rate has an interval instead."""
    values = results.list_values(metric)
    if results.success_count is not None or len(values) < 2:
        return UNKNOWN_TEXT
    low, high = compute_mean_interval(values)
    return f"{low:.2f} to {high:.2f}"


def _format_median(values: list[float], digits: int) -> str:
    if not values:
        return UNKNOWN_TEXT
    return f"{np.median(values):.{digits}f}"
