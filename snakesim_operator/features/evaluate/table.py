"""The table of an evaluation: for each setting and controller, how many fields were crossed, and how."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_operator.features.evaluate.case import GAVE_UP, Case, Outcome
from snakesim_operator.features.evaluate.store import Results

Z95 = 1.959964
T95 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306)  # of 1 to 8 degrees of freedom
UNKNOWN = "–"
HEAD = ("setting", "controller", "crossed", "95 %", "m", "95 % of m", "m/s", "J/m", "stood s", "time s", "errors")
WORST = 5


@dataclass(frozen=True)
class Line:
    """One setting with one controller."""

    row: int
    setting: str
    controller: str
    value: float | None  # of the setting, where that is one number
    outcomes: list[Outcome]

    @property
    def runs(self) -> int:
        """With those that could not begin."""
        return len(self.outcomes)

    @property
    def errors(self) -> int:
        """Cases without a run."""
        return sum(one.error is not None for one in self.outcomes)

    @property
    def crossed(self) -> int | None:
        """Of all runs, also those that could not begin; None when they had no goal."""
        crossings = [one.numbers.get("crossed") for one in self.outcomes if one.error is None]
        return None if crossings and all(one is None for one in crossings) else sum(one is True for one in crossings)

    def values(self, name: str, *, of_crossed: bool = False) -> list[float]:
        """The known values of one number; of_crossed: of the runs that reached their goal, where there is one."""
        chosen = [one for one in self.outcomes if not of_crossed or one.numbers.get("crossed") in (True, None)]
        found = [one.numbers.get(name) for one in chosen]
        return [float(value) for value in found if isinstance(value, int | float)]

    @property
    def cells(self) -> list[str]:
        """As in the table, below HEAD."""
        crossed = self.crossed
        low, high = wilson(crossed or 0, self.runs)
        return [
            self.setting,
            self.controller,
            UNKNOWN if crossed is None else f"{crossed}/{self.runs}",
            UNKNOWN if crossed is None else f"{100 * low:.0f}-{100 * high:.0f}",
            _median(self.values("advance_m"), 2),
            self._advance_interval(),
            _median(self.values("advance_m_s", of_crossed=True), 3),
            _median(self.values("energy_j_per_m", of_crossed=True), 1),
            _median(self.values("stalled_s"), 1),
            _median(self.values("crossed_s" if crossed else "duration_s", of_crossed=True), 1),
            str(self.errors or ""),
        ]

    def _advance_interval(self) -> str:
        """Without a goal the advance is the result, and needs an interval; with one the crossings have it."""
        advances_m = self.values("advance_m")
        if self.crossed is not None or len(advances_m) < 2:
            return UNKNOWN
        low, high = mean_interval(advances_m)
        return f"{low:.2f} to {high:.2f}"


def lines_of(cases: Sequence[Case], done: Results) -> list[Line]:
    """One for each setting and controller that has results, in the order of the cases."""
    found: dict[tuple[int, str], Line] = {}
    for case in cases:
        if case.id in done:
            key = (case.row, case.controller)
            line = found.setdefault(key, Line(case.row, case.setting, case.controller, case.value, []))
            line.outcomes.append(done[case.id])
    return list(found.values())


def columns(lines: Sequence[Line]) -> list[list[str]]:
    """HEAD, and the cells of each line, without the columns of which nothing is known."""
    rows = [list(HEAD), *(line.cells for line in lines)]
    keep = [i for i in range(len(HEAD)) if i < 2 or any(row[i].strip(UNKNOWN) for row in rows[1:])]
    return [[row[i] for i in keep] for row in rows]


def table(lines: Sequence[Line]) -> list[str]:
    """For a terminal. Speed, energy and time are medians of the runs that crossed, the others of all runs."""
    rows = columns(lines)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    texts: list[str] = []
    for row in rows:
        cells = [cell.ljust(w) if i < 2 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))]
        texts.append("  ".join(cells).rstrip())
    return texts


def best_of(lines: Sequence[Line]) -> str:
    """The controller that crossed most: its failures are worth a look."""
    crossed: Counter[str] = Counter()
    for line in lines:
        crossed[line.controller] += line.crossed or 0
    return max(crossed, key=lambda name: crossed[name], default="")


def worst(cases: Sequence[Case], done: Results) -> list[tuple[Case, str]]:
    """The cases that came least far, and why they ended, as far as it is known."""
    failed = [case for case in cases if case.id in done and not _well(done[case.id])]
    failed.sort(key=lambda case: _share(done[case.id]))
    return [(case, _why(done[case.id])) for case in failed[:WORST]]


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % confidence interval of a share (Wilson 1927)."""
    if trials == 0:
        return 0.0, 1.0
    share, z2 = successes / trials, Z95**2 / trials
    middle = (share + z2 / 2) / (1 + z2)
    half = Z95 * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials)) / (1 + z2)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Returns the 95 % confidence interval of the mean, by Student's t. values: two or more."""
    mean = float(np.mean(values))
    standard_error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half = _student_t95(len(values) - 1) * standard_error
    return mean - half, mean + half


def _student_t95(degrees: int) -> float:
    """Two-sided 95 % quantile. Source: Abramowitz and Stegun, table 26.10 and equation 26.7.5."""
    if degrees <= len(T95):
        return T95[degrees - 1]
    first = (Z95**3 + Z95) / 4
    second = (5 * Z95**5 + 16 * Z95**3 + 3 * Z95) / 96
    return Z95 + first / degrees + second / degrees**2


def _median(values: list[float], digits: int) -> str:
    return f"{np.median(values):.{digits}f}" if values else UNKNOWN


def _well(outcome: Outcome) -> bool:
    crossed = outcome.numbers.get("crossed")
    return outcome.error is None and (
        crossed is True or (crossed is None and outcome.numbers.get("ended") == "complete")
    )


def _share(outcome: Outcome) -> float:
    """Of the way to the goal; without a run less than nothing."""
    way, goal = outcome.numbers.get("advance_m"), outcome.numbers.get("goal_m")
    if outcome.error is not None or not isinstance(way, float):
        return -1.0
    return way / goal if isinstance(goal, float) and goal > 0 else way


def _why(outcome: Outcome) -> str:
    if outcome.error is not None:
        return outcome.error
    numbers = outcome.numbers
    way, goal = numbers.get("advance_m"), numbers.get("goal_m")
    far = f"{way:.2f} m" if isinstance(way, float) else "unknown"
    of = f" of {goal:g} m" if isinstance(goal, float) else ""
    state, reason = numbers.get("last_state"), numbers.get("last_reason")
    if state is None:  # the pose is unknown, and with it the motion
        state, reason = numbers.get("reported_state"), numbers.get("reported_reason")
    last = f"{state}: {reason}" if reason else state
    ended = "" if numbers.get("ended") == "complete" else f"; {numbers.get('ended')}"
    ended += "; given up: no advance for too long" if numbers.get(GAVE_UP) else ""
    return f"{far}{of}; {last or 'controller said nothing'}{ended}"
