"""One line of the benchmark table."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Line:
    """What was compared with what, and how it came out."""

    what: str
    against: str
    ours_us: float
    theirs_us: float
    ratio: float
    most: float | None  # None: no aim

    def row(self) -> str:
        """As a row of a Markdown table."""
        verdict = " | | |"
        if self.most is not None:
            verdict = f" | <= {self.most:g} | {'met' if self.ratio <= self.most else '**missed**'} |"
        return f"| {self.what} | {self.against} | {self.ours_us:.0f} | {self.theirs_us:.0f} | {self.ratio:.2f}{verdict}"


HEADER = "| what | against | ours, µs | theirs, µs | ratio (median) | aim | |\n|---|---|---|---|---|---|---|"


def compare(what: str, against: str, ours_us: Sequence[float], theirs_us: Sequence[float], most: float | None) -> Line:
    """Pair the measurements up, in the order in which they were taken, and quote the median of their ratios."""
    ratio = statistics.median(a / b for a, b in zip(ours_us, theirs_us, strict=True))
    return Line(what, against, statistics.median(ours_us), statistics.median(theirs_us), ratio, most)
