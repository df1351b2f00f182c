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
    aim: str
    met: bool

    def row(self) -> str:
        """As a row of a Markdown table."""
        verdict = "met" if self.met else "**missed**"
        return (
            f"| {self.what} | {self.against} | {self.ours_us:.0f} | {self.theirs_us:.0f} | {self.ratio:.2f} | "
            f"{self.aim} | {verdict} |"
        )


HEADER = "| what | against | ours, µs | theirs, µs | ratio (median) | aim | |\n|---|---|---|---|---|---|---|"


def compare(what: str, against: str, ours_us: Sequence[float], theirs_us: Sequence[float], limit: float) -> Line:
    """Pair the measurements up, in the order in which they were taken, and quote the median of their ratios."""
    ratio = statistics.median(a / b for a, b in zip(ours_us, theirs_us, strict=True))
    aim = f"<= {limit:g}"
    return Line(what, against, statistics.median(ours_us), statistics.median(theirs_us), ratio, aim, ratio <= limit)
