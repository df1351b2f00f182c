"""The rows of the benchmark table."""

import statistics
from collections.abc import Sequence

HEADER = "| what | against | ours, µs | theirs, µs | ratio (median) | aim | |\n|---|---|---|---|---|---|---|"


def row(what: str, against: str, ours_us: Sequence[float], theirs_us: Sequence[float], most: float | None) -> str:
    """What was compared with what, and how it came out. most: the largest ratio that is aimed at; None: no aim.

    Measurements are paired up in the order in which they were taken, and the median of their ratios is quoted.
    """
    ratio = statistics.median(a / b for a, b in zip(ours_us, theirs_us, strict=True))
    verdict = "| |" if most is None else f"<= {most:g} | {'met' if ratio <= most else '**missed**'} |"
    medians = f"{statistics.median(ours_us):.0f} | {statistics.median(theirs_us):.0f}"
    return f"| {what} | {against} | {medians} | {ratio:.2f} | {verdict}"
