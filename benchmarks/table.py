"""The rows of the benchmark table."""

import statistics
from collections.abc import Sequence

HEADER = "| what | against | ours, µs | theirs, µs | ratio (median) | aim | result |\n|---|---|---|---|---|---|---|"


def format_row(
    subject: str, reference: str, ours_us: Sequence[float], theirs_us: Sequence[float], max_ratio: float | None
) -> str:
    """Return one row of the table: a measurement, its reference, and the ratio of the two.

    Args:
        subject: what was measured.
        reference: what it is compared with.
        ours_us: measurements of the subject, in µs.
        theirs_us: measurements of the reference, in µs; each was taken in the same round as its counterpart.
        max_ratio: the ratio that is aimed at; None if there is no aim.
    """
    ratio = statistics.median(ours / theirs for ours, theirs in zip(ours_us, theirs_us, strict=True))
    if max_ratio is None:
        verdict = "| |"
    elif ratio <= max_ratio:
        verdict = f"<= {max_ratio:g} | met |"
    else:
        verdict = f"<= {max_ratio:g} | **missed** |"
    medians = f"{statistics.median(ours_us):.0f} | {statistics.median(theirs_us):.0f}"
    return f"| {subject} | {reference} | {medians} | {ratio:.2f} | {verdict}"
