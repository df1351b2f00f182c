"""The table of an evaluation: for each setting and controller, how many runs reached the goal, and how."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_operator.features.evaluate.case import GAVE_UP_FIELD, CaseOutcome, EvaluationCase
from snakesim_operator.features.evaluate.store import Results
from snakesim_operator.results.metrics.intervals import Z95, compute_mean_interval

UNKNOWN_TEXT = "–"
# Headings of the columns. "reached goal": runs that reached their goal. "net": of runs without a goal, whose
# displacement from start to end counts, in any direction.
SETTING = "setting"
CONTROLLER = "controller"
REACHED_GOAL = "reached goal"
CROSSED_INTERVAL = "95 %"
ADVANCE_M = "m"
ADVANCE_INTERVAL_M = "95 % of m"
SPEED_M_S = "m/s"
ENERGY_J_PER_M = "J/m"
NET_M = "net m"
NET_INTERVAL_M = "95 % of net m"
NET_SPEED_M_S = "net m/s"
NET_ENERGY_J_PER_M = "net J/m"
STALLED_S = "stood s"
DURATION_S = "time s"
ERRORS = "errors"
HEADINGS = (
    SETTING,
    CONTROLLER,
    REACHED_GOAL,
    CROSSED_INTERVAL,
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
TEXT_COLUMN_COUNT = 2  # setting and controller: always shown, and aligned to the left
MAX_LISTED_FAILURES = 5  # that are listed


@dataclass(frozen=True)
class ResultRow:
    """The results of all runs of one setting with one controller: a row of the table."""

    row: int  # number of the setting, from 1
    setting: str
    controller: str
    value: float | None  # of the setting, where that is one number
    outcomes: list[CaseOutcome]  # one for each run

    @property
    def runs(self) -> int:
        """The number of runs, with those that could not begin."""
        return len(self.outcomes)

    @property
    def errors(self) -> int:
        """The number of cases without a run."""
        return sum(outcome.error is not None for outcome in self.outcomes)

    @property
    def success_count(self) -> int | None:
        """The number of runs that reached their goal; None if they had no goal."""
        goal_results = [
            outcome.numbers.get("reached_goal")
            for outcome in self.outcomes
            if outcome.error is None
        ]
        had_no_goal = goal_results and all(reached is None for reached in goal_results)
        if had_no_goal:
            return None
        return sum(reached is True for reached in goal_results)

    def list_values(self, name: str, *, successful_only: bool = False) -> list[float]:
        """Return the values of one field of the summary in all runs in which it is known.

        Args:
            name: Name of a field of the summary.
            successful_only: Whether to leave out the runs that had a goal and did not reach it.
        """
        values: list[float] = []
        for outcome in self.outcomes:
            missed_goal = outcome.numbers.get("reached_goal") not in (True, None)
            value = outcome.numbers.get(name)
            if isinstance(value, int | float) and not (successful_only and missed_goal):
                values.append(float(value))
        return values

    def format_cells(self) -> list[str]:
        """Return the texts of this row of the table of results, one for each heading in HEADINGS; some are UNKNOWN.

        Distances and stalls are those of all runs. Speed, energy and time are those of the runs that reached their
        goal, or that had none. Each number is a median, but intervals are 95 % confidence intervals of means.
        """
        duration = "goal_reached_s" if self.success_count else "duration_s"
        cells = {
            SETTING: self.setting,
            CONTROLLER: self.controller,
            REACHED_GOAL: self._format_success_count(),
            CROSSED_INTERVAL: self._format_success_interval(),
            ADVANCE_M: _format_median(self.list_values("advance_m"), 2),
            ADVANCE_INTERVAL_M: self._format_mean_interval("advance_m"),
            SPEED_M_S: _format_median(self.list_values("advance_m_s", successful_only=True), 3),
            ENERGY_J_PER_M: _format_median(
                self.list_values("energy_j_per_m", successful_only=True), 1
            ),
            **self._format_net_displacement_cells(),
            STALLED_S: _format_median(self.list_values("stalled_s"), 1),
            DURATION_S: _format_median(self.list_values(duration, successful_only=True), 1),
            ERRORS: str(self.errors or ""),
        }
        return [cells[heading] for heading in HEADINGS]

    def _format_success_count(self) -> str:
        if self.success_count is None:
            return UNKNOWN_TEXT
        return f"{self.success_count}/{self.runs}"

    def _format_success_interval(self) -> str:
        if self.success_count is None:
            return UNKNOWN_TEXT
        low, high = compute_wilson_interval(self.success_count, self.runs)
        return f"{100 * low:.0f}-{100 * high:.0f}"

    def _format_net_displacement_cells(self) -> dict[str, str]:
        """Return the cells about the displacement from start to end, by heading.

        They are UNKNOWN for runs with a goal, for which the advance towards the goal counts instead.
        """
        if self.success_count is not None:
            return dict.fromkeys(
                (NET_M, NET_INTERVAL_M, NET_SPEED_M_S, NET_ENERGY_J_PER_M), UNKNOWN_TEXT
            )
        return {
            NET_M: _format_median(self.list_values("net_displacement_m"), 2),
            NET_INTERVAL_M: self._format_mean_interval("net_displacement_m"),
            NET_SPEED_M_S: _format_median(self.list_values("displacement_m_s"), 3),
            NET_ENERGY_J_PER_M: _format_median(self.list_values("displacement_energy_j_per_m"), 1),
        }

    def _format_mean_interval(self, name: str) -> str:
        """Return the interval of a mean; with a goal, the success rate has an interval instead."""
        values = self.list_values(name)
        if self.success_count is not None or len(values) < 2:
            return UNKNOWN_TEXT
        low, high = compute_mean_interval(values)
        return f"{low:.2f} to {high:.2f}"


def group_results_by_row(
    cases: Sequence[EvaluationCase], outcome_by_id: Results
) -> list[ResultRow]:
    """Return a row for each setting and controller that has results, in the order of the cases."""
    rows: dict[tuple[int, str], ResultRow] = {}
    for case in cases:
        if case.id in outcome_by_id:
            key = (case.row, case.controller)
            row = rows.setdefault(
                key, ResultRow(case.row, case.setting, case.controller, case.value, [])
            )
            row.outcomes.append(outcome_by_id[case.id])
    return list(rows.values())


def make_result_table(rows: Sequence[ResultRow]) -> list[list[str]]:
    """Return HEADINGS and the cells of each row, without the columns in which nothing is known."""
    table = [list(HEADINGS), *(row.format_cells() for row in rows)]
    shown_columns: list[int] = []
    for column in range(len(HEADINGS)):
        has_a_value = any(cells[column].strip(UNKNOWN_TEXT) for cells in table[1:])
        if column < TEXT_COLUMN_COUNT or has_a_value:
            shown_columns.append(column)
    return [[cells[column] for column in shown_columns] for cells in table]


def format_table(rows: Sequence[ResultRow]) -> list[str]:
    """Return the table for a terminal.

    Speed, energy and time are medians of the runs that reached the goal. Other values are medians of all runs.
    """
    table = make_result_table(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines: list[str] = []
    for cells in table:
        padded: list[str] = []
        for column, (cell, width) in enumerate(zip(cells, widths, strict=True)):
            is_text = column < TEXT_COLUMN_COUNT
            padded.append(cell.ljust(width) if is_text else cell.rjust(width))
        lines.append("  ".join(padded).rstrip())
    return lines


def find_best_controller(rows: Sequence[ResultRow]) -> str:
    """Return the controller that reached the goal most often; its failures are the most interesting ones."""
    success_counts: Counter[str] = Counter()
    for row in rows:
        success_counts[row.controller] += row.success_count or 0
    return max(success_counts, key=lambda name: success_counts[name], default="")


def find_worst_failures(
    cases: Sequence[EvaluationCase], outcome_by_id: Results
) -> list[tuple[EvaluationCase, str]]:
    """Return the cases that failed and advanced least, each with how it ended, as far as that is known."""
    failed = [
        case
        for case in cases
        if case.id in outcome_by_id and not _has_succeeded(outcome_by_id[case.id])
    ]
    failed.sort(key=lambda case: _compute_advance_fraction(outcome_by_id[case.id]))
    return [(case, _describe_end(outcome_by_id[case.id])) for case in failed[:MAX_LISTED_FAILURES]]


def compute_wilson_interval(success_count: int, trial_count: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a success rate.

    With p = successes / n, n trials and z = 1.96:

        (p + z^2 / (2 n) -+ z sqrt(p (1 - p) / n + z^2 / (4 n^2))) / (1 + z^2 / n)

    Source: Wilson (1927), "Probable inference, the law of succession, and statistical inference".
    """
    if trial_count == 0:
        return 0.0, 1.0
    p = success_count / trial_count
    z2_by_n = Z95**2 / trial_count
    center = (p + z2_by_n / 2) / (1 + z2_by_n)
    half_width = (
        Z95 * math.sqrt(p * (1 - p) / trial_count + z2_by_n / (4 * trial_count)) / (1 + z2_by_n)
    )
    return max(center - half_width, 0.0), min(center + half_width, 1.0)


def _format_median(values: list[float], digits: int) -> str:
    if not values:
        return UNKNOWN_TEXT
    return f"{np.median(values):.{digits}f}"


def _has_succeeded(outcome: CaseOutcome) -> bool:
    """Return whether a run reached its goal; without a goal, whether it ran to its end."""
    if outcome.error is not None:
        return False
    reached_goal = outcome.numbers.get("reached_goal")
    if reached_goal is None:
        return outcome.numbers.get("ended") == "complete"
    return reached_goal is True


def _compute_advance_fraction(outcome: CaseOutcome) -> float:
    """Return the advance as a fraction of the way to the goal, to sort by; -1 without a run, in m without a goal."""
    advance_m = outcome.numbers.get("advance_m")
    goal_m = outcome.numbers.get("goal_m")
    if outcome.error is not None or not isinstance(advance_m, float):
        return -1.0
    if isinstance(goal_m, float) and goal_m > 0:
        return advance_m / goal_m
    return advance_m


def _describe_end(outcome: CaseOutcome) -> str:
    """Describe the end of one run: its advance, the last state that its controller reported, and how it ended.

    Args:
        outcome: The metrics of the run's summary, or the error of a case that could not run.

    Returns:
        Phrases separated by semicolons, or the error.
    """
    if outcome.error is not None:
        return outcome.error
    metrics = outcome.numbers
    advance_m = metrics.get("advance_m")
    goal_m = metrics.get("goal_m")
    advance_text = f"{advance_m:.2f} m" if isinstance(advance_m, float) else "unknown"
    if isinstance(goal_m, float):
        advance_text += f" of {goal_m:g} m"
    state = metrics.get("last_state")
    reason = metrics.get("last_reason")
    if state is None:  # the pose is unknown, and with it the motion
        state = metrics.get("reported_state")
        reason = metrics.get("reported_reason")
    phrases = [advance_text]
    if reason:
        phrases.append(f"{state}: {reason}")
    else:
        phrases.append(str(state or "controller reported nothing"))
    if metrics.get("ended") != "complete":
        phrases.append(str(metrics.get("ended")))
    if metrics.get(GAVE_UP_FIELD):
        phrases.append("ended early: no advance for too long")
    return "; ".join(phrases)
