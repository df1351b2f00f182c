"""The outcomes of one condition with one controller: counts, values of metrics, and which trials failed worst."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_operator.features.evaluate.store import OutcomeById
from snakesim_operator.features.evaluate.trial import (
    ENDED_BY_STALL_METRIC,
    EvaluationTrial,
    TrialOutcome,
)

MAX_LISTED_FAILURES = 5


@dataclass(frozen=True)
class ConditionResults:
    """The outcomes of all trials of one condition with one controller: a row of the table of results."""

    condition_number: int  # from 1
    condition_name: str
    controller: str
    varied_number: float | None  # of the condition, if it varies a single number
    outcomes: list[TrialOutcome]  # one for each trial

    @property
    def trial_count(self) -> int:
        """The number of trials, with those that could not run."""
        return len(self.outcomes)

    @property
    def error_count(self) -> int:
        """The number of trials that could not run."""
        return sum(outcome.error is not None for outcome in self.outcomes)

    @property
    def success_count(self) -> int | None:
        """The number of trials that reached their goal; None if they had no goal."""
        goal_results = [
            outcome.metrics.get("reached_goal")
            for outcome in self.outcomes
            if outcome.error is None
        ]
        had_no_goal = goal_results and all(reached is None for reached in goal_results)
        if had_no_goal:
            return None
        return sum(reached is True for reached in goal_results)

    def list_values(self, metric: str, *, successful_only: bool = False) -> list[float]:
        """Return the values of one metric in all trials in which it is known.

        Args:
            metric: Name of a number of the run's summary.
            successful_only: Whether to leave out the trials that had a goal and did not reach it.
        """
        values: list[float] = []
        for outcome in self.outcomes:
            missed_goal = outcome.metrics.get("reached_goal") not in (True, None)
            value = outcome.metrics.get(metric)
            if isinstance(value, int | float) and not (successful_only and missed_goal):
                values.append(float(value))
        return values


def group_outcomes_by_condition(
    trials: Sequence[EvaluationTrial], outcome_by_id: OutcomeById
) -> list[ConditionResults]:
    """Return the results of each condition with each controller in the order of the trials, if there are any."""
    results_by_key: dict[tuple[int, str], ConditionResults] = {}
    for trial in trials:
        if trial.id not in outcome_by_id:
            continue
        key = (trial.condition_number, trial.controller)
        if key not in results_by_key:
            results_by_key[key] = ConditionResults(
                condition_number=trial.condition_number,
                condition_name=trial.condition_name,
                controller=trial.controller,
                varied_number=trial.varied_number,
                outcomes=[],
            )
        results_by_key[key].outcomes.append(outcome_by_id[trial.id])
    return list(results_by_key.values())


def find_best_controller(results: Sequence[ConditionResults]) -> str:
    """Return the controller that reached the goal most often; its failures are the most interesting ones."""
    success_counts: Counter[str] = Counter()
    for condition_results in results:
        success_counts[condition_results.controller] += condition_results.success_count or 0
    return max(success_counts, key=lambda name: success_counts[name], default="")


def find_worst_failures(
    trials: Sequence[EvaluationTrial], outcome_by_id: OutcomeById
) -> list[tuple[EvaluationTrial, str]]:
    """Return the trials that failed and advanced least, each with how it ended, as far as that is known."""
    failed = [
        trial
        for trial in trials
        if trial.id in outcome_by_id and not _has_succeeded(outcome_by_id[trial.id])
    ]
    failed.sort(key=lambda trial: _compute_advance_fraction(outcome_by_id[trial.id]))
    return [
        (trial, _describe_end(outcome_by_id[trial.id])) for trial in failed[:MAX_LISTED_FAILURES]
    ]


def _has_succeeded(outcome: TrialOutcome) -> bool:
    """Return whether a trial reached its goal; without a goal, whether it ran to its end."""
    if outcome.error is not None:
        return False
    reached_goal = outcome.metrics.get("reached_goal")
    if reached_goal is None:
        return outcome.metrics.get("ended") == "complete"
    return reached_goal is True


def _compute_advance_fraction(outcome: TrialOutcome) -> float:
    """Return a number to sort failures by.

    It is the advance as a fraction of the distance to the goal. Without a goal it is the advance in m, and without an
    advance it is -1.
    """
    advance_m = outcome.metrics.get("advance_m")
    goal_m = outcome.metrics.get("goal_m")
    if outcome.error is not None or not isinstance(advance_m, float):
        return -1.0
    if isinstance(goal_m, float) and goal_m > 0:
        return advance_m / goal_m
    return advance_m


def _describe_end(outcome: TrialOutcome) -> str:
    """Describe the end of a trial: its advance, the last state that its controller reported, and how it ended.

    Args:
        outcome: The metrics of the run's summary, or the error of a trial that could not run.

    Returns:
        Phrases separated by semicolons, or the error.
    """
    if outcome.error is not None:
        return outcome.error
    metrics = outcome.metrics
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
    if metrics.get(ENDED_BY_STALL_METRIC):
        phrases.append("ended early: no advance for too long")
    return "; ".join(phrases)
