"""What `snakesim reproduce` prints, and the same as Markdown and as JSON."""

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from snakesim_operator.features.reproduce.experiment import (
    DifferenceReason,
    Experiment,
    ExperimentFindings,
    PublishedComparison,
)

WIDTH = 100
LABEL_WIDTH = 12
BASIS_TEXTS = {
    "printed": "printed in the source",
    "formula": "by a formula of the source, evaluated here",
    "model": "by equations of the source, solved here",
}


def list_lines(experiments: Sequence[Experiment]) -> Iterator[str]:
    """Yield a line for each experiment: name, year and source."""
    width = max(len(experiment.name) for experiment in experiments)
    for experiment in experiments:
        yield f"{experiment.name:<{width}}  {experiment.source.year}  {experiment.source.short_text}"


def describe_lines(experiment: Experiment, findings: ExperimentFindings) -> Iterator[str]:
    """Yield what an experiment states and found, line by line."""
    source = experiment.source
    yield experiment.name
    yield from _labeled(
        "source", f"{source.short_text}. {source.published_in}, {source.year}: {source.place}"
    )
    yield from _labeled("seen", source.seen)
    yield from _labeled("claim", experiment.claim)
    yield from _labeled("conditions", f"Published: {experiment.published_conditions}")
    yield from _labeled("", f"Ours: {experiment.our_conditions}")
    yield from _labeled("method", experiment.method)
    if not experiment.depends_on_seed:
        yield from _labeled(
            "", "The gait has no feedback, so that every seed gives the same motion."
        )
    for comparison in findings.comparisons:
        yield ""
        yield f"{comparison.quantity}{format_unit(comparison.unit)}"
        yield from _labeled(
            "published",
            f"{format_value(comparison.published)} ({BASIS_TEXTS[comparison.basis]})",
            indent=2,
        )
        yield from _labeled("ours", describe_ours(comparison), indent=2)
        yield from _labeled("difference", describe_difference(comparison), indent=2)
    yield ""
    yield "why they differ"
    for reason in findings.reasons:
        yield from _labeled(format_effect(reason), reason.cause, indent=2)
    for note in findings.notes:
        yield ""
        yield from textwrap.wrap(note, WIDTH)


def _labeled(label: str, text: str, indent: int = 0) -> list[str]:
    """Return a label and a wrapped text beside it."""
    first = " " * indent + f"{label:<{LABEL_WIDTH}}  "
    return textwrap.wrap(text, WIDTH, initial_indent=first, subsequent_indent=" " * len(first))


def describe_ours(comparison: PublishedComparison) -> str:
    """Return our value, with its interval and the number of runs."""
    text = format_value(comparison.ours)
    if comparison.interval is not None:
        low, high = comparison.interval
        text += f", 95 % interval {format_value(low)} to {format_value(high)}"
    return f"{text} ({comparison.runs} run{'s' if comparison.runs > 1 else ''})"


def describe_difference(comparison: PublishedComparison) -> str:
    """Return ours minus the published value, also in percent; for texts whether they are the same."""
    difference = comparison.difference
    if difference is None:
        return "none: both are the same" if comparison.agrees else "they are not the same"
    text = format_signed(difference, 3)
    if isinstance(comparison.published, float) and comparison.published != 0.0:
        text += f" ({100 * difference / abs(comparison.published):+.1f} %)"
    return text


def format_effect(reason: DifferenceReason) -> str:
    """Return the effect of a reason on our value."""
    if reason.effect is None:
        return "unknown"
    return format_signed(reason.effect, 2) + ("" if reason.unit == "1" else f" {reason.unit}")


def format_signed(value: float, digits: int) -> str:
    """Return a number with its sign, with so many significant digits and without an exponent."""
    return np.format_float_positional(
        value, precision=digits, fractional=False, sign=True, trim="-"
    )


def format_value(value: float | str) -> str:
    """Return a value with four digits, or a text as it is."""
    return value if isinstance(value, str) else f"{value:.4g}"


def format_unit(unit: str) -> str:
    """Return a unit in brackets; nothing for numbers without one and for texts."""
    return "" if unit in ("", "1") else f" [{unit}]"


def make_record(experiment: Experiment, findings: ExperimentFindings) -> dict[str, Any]:
    """Return what an experiment states and found, for JSON."""
    comparisons = [
        {
            "quantity": comparison.quantity,
            "unit": comparison.unit,
            "published": comparison.published,
            "basis": comparison.basis,
            "ours": comparison.ours,
            "interval": comparison.interval,
            "runs": comparison.runs,
            "difference": comparison.difference,
            "agrees": comparison.agrees,
        }
        for comparison in findings.comparisons
    ]
    return {
        **make_entry(experiment),
        "claim": experiment.claim,
        "published_conditions": experiment.published_conditions,
        "our_conditions": experiment.our_conditions,
        "method": experiment.method,
        "depends_on_seed": experiment.depends_on_seed,
        "comparisons": comparisons,
        "reasons": list(findings.reasons),
        "notes": list(findings.notes),
    }


def make_entry(experiment: Experiment) -> dict[str, Any]:
    """Return name, source and year of an experiment, for JSON."""
    return {"name": experiment.name, "source": experiment.source, "year": experiment.source.year}
