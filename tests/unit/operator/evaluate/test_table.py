"""The table of results: intervals, medians of successful trials, and the worst failures first."""

import math

import numpy as np
import pytest

from snakesim_operator.features.evaluate.condition_results import (
    find_worst_failures,
    group_outcomes_by_condition,
)
from snakesim_operator.features.evaluate.table import UNKNOWN_TEXT, format_table
from snakesim_operator.features.evaluate.trial import EvaluationTrial, TrialOutcome
from snakesim_operator.results.metrics.intervals import (
    compute_mean_interval,
    compute_wilson_interval,
)

GOAL_M = 3.0


def make_trial(seed: int, controller: str = "poal", condition_number: int = 1) -> EvaluationTrial:
    return EvaluationTrial(
        id=f"{controller}-{condition_number}-{seed}",
        condition_number=condition_number,
        condition_name=f"density {condition_number}",
        controller=controller,
        seed=seed,
        config=b"{}",
        stall_timeout_s=12.0,
        wall_timeout_s=60.0,
    )


def make_outcome(advance_m: float, speed_m_s: float = 0.1) -> TrialOutcome:
    """Make the outcome of a trial that succeeds if it advances by GOAL_M."""
    return TrialOutcome(
        metrics={
            "goal_m": GOAL_M,
            "advance_m": advance_m,
            "reached_goal": advance_m >= GOAL_M,
            "ended": "complete",
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


def test_table_speed_includes_only_successful_trials() -> None:
    trials = [make_trial(1), make_trial(2), make_trial(3), make_trial(1, "hold")]
    outcome_by_id = {
        "poal-1-1": make_outcome(GOAL_M, 0.2),
        "poal-1-2": make_outcome(1.0, 0.02),
        "poal-1-3": TrialOutcome(error="no room"),
    }
    results = group_outcomes_by_condition(trials, outcome_by_id)
    assert [row.controller for row in results] == ["poal"]  # `hold` has no outcome yet
    heading, row = format_table(results)
    assert heading.split()[:4] == ["condition", "controller", "reached", "goal"]
    assert "1/3" in row
    assert "0.200" in row
    assert row.endswith(" 1")


def test_table_without_a_goal_shows_an_interval_of_the_advance() -> None:
    """The interval is that of the mean, by Student's t: 12.7 times its standard error for two trials."""
    trials = [make_trial(1), make_trial(2), make_trial(1, condition_number=2)]
    outcome_by_id = {
        trial.id: TrialOutcome(metrics={"advance_m": 0.2 + 0.01 * trial.seed, "ended": "complete"})
        for trial in trials
    }
    heading, two_trials, one_trial = format_table(
        group_outcomes_by_condition(trials, outcome_by_id)
    )
    assert heading.split()[-5:] == ["m", "95", "%", "of", "m"]
    assert two_trials.endswith("0.15 to 0.28")
    assert one_trial.endswith(UNKNOWN_TEXT)
    only_one_trial = group_outcomes_by_condition([trials[2]], outcome_by_id)
    assert "95 %" not in format_table(only_one_trial)[0]


def test_table_without_a_goal_shows_the_net_displacement() -> None:
    """A gait that travels sideways advances 0.05 m along its heading, and 0.8 m in all."""
    sideways = {
        "advance_m": 0.05,
        "net_displacement_m": 0.8,
        "displacement_m_s": 0.08,
        "ended": "complete",
    }
    trials = [make_trial(1), make_trial(2)]
    without_goal = TrialOutcome(metrics={**sideways, "displacement_energy_j_per_m": 21.5})
    outcome_by_id = {trial.id: without_goal for trial in trials}
    heading, row = format_table(group_outcomes_by_condition(trials, outcome_by_id))
    assert "net m  95 % of net m  net m/s  net J/m" in heading
    assert row.split()[-6:] == ["0.80", "0.80", "to", "0.80", "0.080", "21.5"]

    with_goal = TrialOutcome(metrics={**sideways, "reached_goal": False, "goal_m": GOAL_M})
    outcome_by_id = {trial.id: with_goal for trial in trials}
    heading, _ = format_table(group_outcomes_by_condition(trials, outcome_by_id))
    assert "net m" not in heading


@pytest.mark.parametrize(
    ("runs", "quantile"), [(2, 12.706), (4, 3.182), (11, 2.228), (31, 2.042), (1001, 1.962)]
)
def test_table_student_t_equals_tables(runs: int, quantile: float) -> None:
    values = [0.0, 1.0] * (runs // 2) + [0.5] * (runs % 2)
    low, high = compute_mean_interval(values)
    standard_error = float(np.std(values, ddof=1)) / math.sqrt(runs)
    assert (high - low) / 2 / standard_error == pytest.approx(quantile, rel=2e-3)


def test_table_lists_worst_failures_first() -> None:
    trials = [make_trial(seed) for seed in (1, 2, 3, 4)]
    outcome_by_id = {
        "poal-1-1": make_outcome(2.0),
        "poal-1-2": make_outcome(GOAL_M),
        "poal-1-3": TrialOutcome(error="no room"),
        "poal-1-4": make_outcome(0.5),
    }
    failures = find_worst_failures(trials, outcome_by_id)
    assert [trial.seed for trial, _ in failures] == [3, 4, 1]
    assert [reason for _, reason in failures] == [
        "no room",
        "0.50 m of 3 m; NotLocomoting: stuck",
        "2.00 m of 3 m; NotLocomoting: stuck",
    ]
