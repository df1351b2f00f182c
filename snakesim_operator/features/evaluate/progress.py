"""The progress line of an evaluation, with the remaining time: rewritten in place on a terminal."""

import time

from snakesim_operator.features.evaluate.case import Outcome
from snakesim_operator.run.progress import OneLine, in_minutes

PLAIN_PERIOD_S = 10.0


class Progress(OneLine):
    """Counts what is done."""

    def __init__(self, total: int) -> None:
        super().__init__()
        self._total = total
        self._done = self._with_goal = self._crossed = self._errors = 0
        self._began = time.monotonic()
        self._next = self._began + PLAIN_PERIOD_S

    def done(self, outcome: Outcome) -> None:
        """One more."""
        self._done += 1
        self._with_goal += isinstance(outcome.numbers.get("crossed"), bool)
        self._crossed += outcome.numbers.get("crossed") is True
        self._errors += outcome.error is not None
        now = time.monotonic()
        if self.terminal or now >= self._next or self._done == self._total:
            self._next = now + PLAIN_PERIOD_S
            self.put(self._text(now))

    def _text(self, now: float) -> str:
        passed_s = now - self._began
        left_s = passed_s / self._done * (self._total - self._done)
        parts = [f"{self._done} of {self._total} cases"]
        if self._with_goal:
            parts.append(f"{self._crossed} crossed")
        if self._errors:
            parts.append(f"{self._errors} could not run")
        return "  ".join([*parts, f"{in_minutes(passed_s)} passed, about {in_minutes(left_s)} left"])
