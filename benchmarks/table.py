"""The rows of the benchmark tables, and the page that they are kept in."""

import statistics
from collections.abc import Sequence
from pathlib import Path

RATIO_HEADER = (
    "| what | against | ours, µs | theirs, µs | ratio (median) | goal | result "
    "|\n|---|---|---|---|---|---|---|"
)
GOAL_HEADER = "| what | median (range) | goal | result |\n|---|---|---|---|"
HEADING = "## "
MIN_INTEGER = 100  # numbers from here on are written without decimals


def format_row(
    subject: str,
    reference: str,
    ours_us: Sequence[float],
    theirs_us: Sequence[float],
    max_ratio: float | None,
) -> str:
    """Return one row of a table of ratios: a measurement, its reference, and the ratio of the two.

    Args:
        subject: what was measured.
        reference: what it is compared with.
        ours_us: measurements of the subject, in µs.
        theirs_us: measurements of the reference, in µs; each was taken in the same round as its counterpart.
        max_ratio: the goal; None if there is none.
    """
    ratio = statistics.median(
        ours / theirs for ours, theirs in zip(ours_us, theirs_us, strict=True)
    )
    verdict = "| |" if max_ratio is None else f"<= {max_ratio:g} | {_judge(ratio <= max_ratio)} |"
    medians = f"{statistics.median(ours_us):.0f} | {statistics.median(theirs_us):.0f}"
    return f"| {subject} | {reference} | {medians} | {ratio:.2f} | {verdict}"


def format_interval(values: Sequence[float]) -> str:
    """Return the median of some values with their range, such as `10.6 (10.5 to 10.7)`."""
    median = statistics.median(values)
    return (
        f"{_format_number(median)} ({_format_number(min(values))} to {_format_number(max(values))})"
    )


def _format_number(value: float) -> str:
    """Format a number with three digits, or with all its digits before the decimal point."""
    if abs(value) >= MIN_INTEGER:
        return f"{value:.0f}"
    return f"{value:.3g}"


def format_maximum_row(subject: str, values: Sequence[float], maximum: float, unit: str) -> str:
    """Return one row of a table of goals, for a quantity that should be small."""
    is_met = statistics.median(values) <= maximum
    return f"| {subject} | {format_interval(values)} {unit} | <= {maximum:g} {unit} | {_judge(is_met)} |"


def format_minimum_row(subject: str, values: Sequence[float], minimum: float, unit: str) -> str:
    """Return one row of a table of goals, for a quantity that should be large."""
    is_met = statistics.median(values) >= minimum
    return f"| {subject} | {format_interval(values)} {unit} | >= {minimum:g} {unit} | {_judge(is_met)} |"


def _judge(is_met: bool) -> str:
    return "met" if is_met else "**missed**"


def replace_section(page: Path, title: str, text: str) -> None:
    """Replace the section of a page that has this title, or add it at the end.

    Args:
        page: a Markdown file whose sections begin with `## `.
        title: of the section.
        text: the lines below the title.
    """
    heading = f"{HEADING}{title}"
    introduction, *sections = page.read_text(encoding="utf-8").split(f"\n{HEADING}")
    blocks = {
        section.partition("\n")[0]: section.partition("\n")[2].strip() for section in sections
    }
    blocks[title] = text.strip()
    body = "".join(f"\n\n{HEADING}{name}\n\n{block}" for name, block in blocks.items())
    assert heading in body
    page.write_text(f"{introduction.strip()}{body}\n", encoding="utf-8")
