"""The progress line of an evaluation, with the remaining time: rewritten in place on a terminal."""

import time

from snakesim_operator.features.evaluate.trial import TrialOutcome
from snakesim_operator.run.progress import StatusLine, format_duration

PLAIN_PERIOD_S = 10.0  # between two lines if the output is no terminal


class TrialProgress(StatusLine):
    """Counts the finished trials, and prints how many there are."""

    def __init__(self, total: int) -> None:
        super().__init__()
        # Numbers of trials.
        self._total = total
        self._finished_count = 0
        self._goal_count = 0  # of missions that have a goal
        self._success_count = 0
        self._error_count = 0
        # Times, by the monotonic clock.
        self._start_s = time.monotonic()
        self._next_line_s = self._start_s + PLAIN_PERIOD_S

    def count_outcome(self, outcome: TrialOutcome) -> None:
        """Count one more trial, and print the line if it is due."""
        reached_goal = outcome.metrics.get("reached_goal")
        self._finished_count += 1
        self._goal_count += isinstance(reached_goal, bool)
        self._success_count += reached_goal is True
        self._error_count += outcome.error is not None
        now_s = time.monotonic()
        is_last = self._finished_count == self._total
        if self.is_terminal or now_s >= self._next_line_s or is_last:
            self._next_line_s = now_s + PLAIN_PERIOD_S
            self.show_text(self._format_text(now_s))

    def _format_text(self, now_s: float) -> str:
        elapsed_s = now_s - self._start_s
        remaining_s = elapsed_s / self._finished_count * (self._total - self._finished_count)
        parts = [f"{self._finished_count} of {self._total} trials"]
        if self._goal_count:
            parts.append(f"{self._success_count} reached the goal")
        if self._error_count:
            parts.append(f"{self._error_count} could not run")
        parts.append(
            f"{format_duration(elapsed_s)} passed, about {format_duration(remaining_s)} left"
        )
        return "  ".join(parts)
