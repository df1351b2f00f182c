"""The table: intervals, medians of successful runs, and the worst failures first."""

import math

import numpy as np
import pytest

from snakesim_operator.features.evaluate.case import CaseOutcome, EvaluationCase
from snakesim_operator.features.evaluate.table import (
    UNKNOWN_TEXT,
    compute_wilson_interval,
    find_worst_failures,
    format_table,
    group_results_by_row,
)
from snakesim_operator.results.metrics.intervals import compute_mean_interval


def case(field: int, controller: str = "poal", row: int = 1) -> EvaluationCase:
    return EvaluationCase(
        f"{controller}-{row}-{field}", row, f"density {row}", controller, field, b"{}", 12.0, 60.0
    )


def outcome(advance_m: float, speed_m_s: float = 0.1) -> CaseOutcome:
    reported = {
        "goal_m": 3.0,
        "advance_m": advance_m,
        "reached_goal": advance_m >= 3,
        "ended": "complete",
    }
    return CaseOutcome(
        numbers={
            **reported,
            "advance_m_s": speed_m_s,
            "last_state": "NotLocomoting",
            "last_reason": "stuck",
        }
    )


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(8, 10, 0.490, 0.943), (0, 20, 0.0, 0.161), (100, 100, 0.963, 1.0)],
)
def test_table_wilson_interval_equals_tables(
    successes: int, trials: int, low: float, high: float
) -> None:
    assert compute_wilson_interval(successes, trials) == (
        pytest.approx(low, abs=5e-4),
        pytest.approx(high, abs=5e-4),
    )


def test_speed_is_of_the_runs_that_reached_the_goal() -> None:
    cases = [case(1), case(2), case(3), case(1, "hold")]
    done = {
        "poal-1-1": outcome(3.0, 0.2),
        "poal-1-2": outcome(1.0, 0.02),
        "poal-1-3": CaseOutcome(error="no room"),
    }
    lines = group_results_by_row(cases, done)
    assert [line.controller for line in lines] == ["poal"]  # of hold nothing is known yet
    head, row = format_table(lines)
    assert head.split()[:4] == ["setting", "controller", "reached", "goal"]
    assert "1/3" in row
    assert "0.200" in row
    assert row.endswith(" 1")


def test_without_a_goal_the_advance_has_an_interval() -> None:
    """Of the mean, by Student's t: 12.7 of its standard error for two runs."""
    cases = [case(1), case(2), case(1, row=2)]
    done = {
        one.id: CaseOutcome(numbers={"advance_m": 0.2 + 0.01 * one.field, "ended": "complete"})
        for one in cases
    }
    head, two_runs, one_run = format_table(group_results_by_row(cases, done))
    assert head.split()[-5:] == ["m", "95", "%", "of", "m"]
    assert two_runs.endswith("0.15 to 0.28")
    assert one_run.endswith(UNKNOWN_TEXT)
    assert "95 %" not in format_table(group_results_by_row([cases[2]], done))[0]


def test_without_a_goal_the_table_has_the_net_displacement() -> None:
    """A gait that travels sideways advances 0.05 m along its heading, and 0.8 m in all."""
    sideways = {
        "advance_m": 0.05,
        "net_displacement_m": 0.8,
        "displacement_m_s": 0.08,
        "ended": "complete",
    }
    cases = [case(1), case(2)]
    done = {
        one.id: CaseOutcome(numbers={**sideways, "displacement_energy_j_per_m": 21.5})
        for one in cases
    }
    head, row = format_table(group_results_by_row(cases, done))
    assert "net m  95 % of net m  net m/s  net J/m" in head
    assert row.split()[-6:] == ["0.80", "0.80", "to", "0.80", "0.080", "21.5"]
    done = {
        one.id: CaseOutcome(numbers={**sideways, "reached_goal": False, "goal_m": 3.0})
        for one in cases
    }
    assert "net m" not in format_table(group_results_by_row(cases, done))[0]


@pytest.mark.parametrize(
    ("runs", "quantile"), [(2, 12.706), (4, 3.182), (11, 2.228), (31, 2.042), (1001, 1.962)]
)
def test_table_student_t_equals_tables(runs: int, quantile: float) -> None:
    values = [0.0, 1.0] * (runs // 2) + [0.5] * (runs % 2)
    low, high = compute_mean_interval(values)
    standard_error = float(np.std(values, ddof=1)) / math.sqrt(runs)
    assert (high - low) / 2 / standard_error == pytest.approx(quantile, rel=2e-3)


def test_table_lists_worst_cases_first() -> None:
    cases = [case(field) for field in (1, 2, 3, 4)]
    done = {
        "poal-1-1": outcome(2.0),
        "poal-1-2": outcome(3.0),
        "poal-1-3": CaseOutcome(error="no room"),
    }
    done["poal-1-4"] = outcome(0.5)
    reported = find_worst_failures(cases, done)
    assert [one.field for one, _ in reported] == [3, 4, 1]
    assert [why for _, why in reported] == [
        "no room",
        "0.50 m of 3 m; NotLocomoting: stuck",
        "2.00 m of 3 m; NotLocomoting: stuck",
    ]
