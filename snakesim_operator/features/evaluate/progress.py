"""The progress line of an evaluation, with the remaining time: rewritten in place on a terminal."""

import time

from snakesim_operator.features.evaluate.case import CaseOutcome
from snakesim_operator.run.progress import StatusLine, format_duration

PLAIN_PERIOD_S = 10.0  # between two lines where the output is no terminal


class CaseProgress(StatusLine):
    """Counts the cases that are done, and prints how many there are."""

    def __init__(self, total: int) -> None:
        super().__init__()
        # Counts.
        self._total = total
        self._done = 0
        self._with_goal = 0
        self._success_count = 0
        self._errors = 0
        # Times, by the monotonic clock.
        self._start_s = time.monotonic()
        self._next_line_s = self._start_s + PLAIN_PERIOD_S

    def count_outcome(self, outcome: CaseOutcome) -> None:
        """Count one more case, and print the line if it is due."""
        reached_goal = outcome.numbers.get("reached_goal")
        self._done += 1
        self._with_goal += isinstance(reached_goal, bool)
        self._success_count += reached_goal is True
        self._errors += outcome.error is not None
        now_s = time.monotonic()
        if self.is_terminal or now_s >= self._next_line_s or self._done == self._total:
            self._next_line_s = now_s + PLAIN_PERIOD_S
            self.show_text(self._format_text(now_s))

    def _format_text(self, now_s: float) -> str:
        elapsed_s = now_s - self._start_s
        remaining_s = elapsed_s / self._done * (self._total - self._done)
        parts = [f"{self._done} of {self._total} cases"]
        if self._with_goal:
            parts.append(f"{self._success_count} reached the goal")
        if self._errors:
            parts.append(f"{self._errors} could not run")
        parts.append(
            f"{format_duration(elapsed_s)} passed, about {format_duration(remaining_s)} left"
        )
        return "  ".join(parts)
