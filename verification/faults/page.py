"""Writes the fault table from the raw results: all measurements as CSV, and a page that summarizes them."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from verification.faults.results import ROOT, Store
from verification.faults.row import TRIALS, Result, Row, judge
from verification.faults.table import HEADINGS, LEASE_MS, PERIOD_MS, Heading

PAGE = ROOT / "docs" / "benchmarks" / "faults.md"
TABLE_NAME = "fault-table.csv"  # beside the page
COLUMNS: tuple[str, ...] = (
    "row",
    "fault",
    "backend",
    "expected",
    "deadline",
    "limit",
    "unit",
    "median",
    "worst",
    "trials",
    "trials_wanted",
    "retried",
    "result",
    "recovered",
    "max_step_rad",
    "max_first_rad",
    "notes",
    "when",
    "took_s",
    "load_before",
    "machine",
)

INTRODUCTION = """\
# The fault table

`make faults` writes this page{days}; do not edit it. It summarizes
[fault-table.csv]({table}), which has deadline, median, worst value, recovery, machine and notes of each
measurement. [faults.json](faults.json) has every trial.

**{met} of {wanted} measurements met**, {failed} not met, {left} not run. A measurement is met if the robot reacted as
expected within the deadline in its worst trial.

Each row injects a fault at least {trials} times on each backend. The robot is the 13-joint snake of the scenario
`triplet` at 100 Hz in real time (T = {period:.0f} ms, lease {lease:.0f} ms); `can` has emulated joint modules on a
virtual bus.
"""

EXPLANATION = """\
* **Times are upper bounds**, from just before the injection until an observer process has received the first setpoints
  of the host's own stop mode. The host checks the lease once a period.
* **Recovery.** After each trial an operator resets the fault and arms the robot. `max_step_rad` is the largest change
  of an angle target in one tick after that, `max_first_rad` the largest distance of a first target from the measured
  angle (allowed: 0.35 rad).
* **Retried.** A trial is repeated if the robot had stopped before the injection, as on a busy machine.

Measure one row again with `python -m tests.faults --rows NAME --write`.
"""

Results = Mapping[tuple[str, str], Result]


def write(store: Store, page: Path = PAGE) -> Path:
    """Write the page, and the table beside it. Return the path of the page."""
    results = store.read()
    page.with_name(TABLE_NAME).write_text(_format_table(results), encoding="utf-8")
    page.write_text("\n".join(_page_lines(results)), encoding="utf-8")
    return page


def _page_lines(results: Results) -> Iterator[str]:
    wanted = [pair for heading in HEADINGS for pair in _measurable(heading)]
    done = [pair for pair in wanted if _key(pair) in results]
    met = sum(_is_met(pair, results) for pair in done)
    yield INTRODUCTION.format(
        days=_format_days(list(results.values())),
        table=TABLE_NAME,
        met=met,
        wanted=len(wanted),
        failed=len(done) - met,
        left=len(wanted) - len(done),
        trials=TRIALS,
        period=PERIOD_MS,
        lease=LEASE_MS,
    )
    yield "| fault | expected behavior | met |"
    yield "|---|---|---|"
    for heading in HEADINGS:
        pairs = _measurable(heading)
        count = sum(_is_met(pair, results) for pair in pairs)
        text = f"{count} of {len(pairs)}"
        if count < len(pairs):
            text = f"**{text}**"
        yield f"| {heading.fault} | {heading.expected} | {text} |"
    yield ""
    yield EXPLANATION


def _format_days(results: Sequence[Result]) -> str:
    """Return when the results were measured."""
    days = sorted({result.when.split()[0] for result in results})
    if not days:
        return ""
    if len(days) == 1:
        return f", measured on {days[0]}"
    return f", measured from {days[0]} to {days[-1]}"


def _measurable(heading: Heading) -> list[tuple[Row, str]]:
    """Return row and backend of each measurement; a row that does not apply to a backend is left out."""
    pairs: list[tuple[Row, str]] = []
    for row in heading.rows:
        for backend, measure in row.on.items():
            if not isinstance(measure, str):
                pairs.append((row, backend))
    return pairs


def _key(pair: tuple[Row, str]) -> tuple[str, str]:
    row, backend = pair
    return row.name, backend


def _is_met(pair: tuple[Row, str], results: Results) -> bool:
    result = results.get(_key(pair))
    return result is not None and judge(pair[0], result).met


def _format_table(results: Results) -> str:
    """Return the table of all measurements as CSV."""
    text = io.StringIO()
    writer: csv.DictWriter[str] = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for heading in HEADINGS:
        for row in heading.rows:
            for backend, measure in row.on.items():
                cells: dict[str, Any] = {
                    "row": row.name,
                    "fault": row.fault,
                    "backend": "sim and can" if backend == "both" else backend,
                    "expected": row.expected,
                    "deadline": row.deadline,
                    "limit": f"{row.limit:g}",
                    "unit": row.unit,
                }
                result = results.get((row.name, backend))
                if isinstance(measure, str):
                    cells["result"] = f"not applicable: {measure}"
                elif result is None:
                    cells["result"] = "not run"
                else:
                    cells |= _measured_cells(row, result)
                writer.writerow(cells)
    return text.getvalue()


def _measured_cells(row: Row, result: Result) -> dict[str, Any]:
    """Return the cells of a measurement that was made."""
    verdict = judge(row, result)
    return {
        "median": _format_number(verdict.median),
        "worst": _format_number(verdict.worst),
        "trials": len(result.trials),
        "trials_wanted": max(TRIALS, row.least),
        "retried": result.retried,
        "result": "met" if verdict.met else f"not met: {verdict.why}",
        **_recovery_cells(result),
        "notes": "; ".join(result.notes),
        "when": result.when,
        "took_s": f"{result.took_s:.0f}",
        "load_before": f"{result.load:g}",
        "machine": result.machine,
    }


def _recovery_cells(result: Result) -> dict[str, Any]:
    """Return the cells about the recovery; none if there was nothing to recover from."""
    tried = [trial for trial in result.trials if trial.recovered is not None]
    if not tried:
        return {}
    recovered = sum(trial.recovered is True for trial in tried)
    steps_rad = [trial.step_rad for trial in tried if trial.step_rad is not None]
    firsts_rad = [trial.first_rad for trial in tried if trial.first_rad is not None]
    return {
        "recovered": f"{recovered} of {len(tried)}",
        "max_step_rad": _format_number(max(steps_rad, default=None)),
        "max_first_rad": _format_number(max(firsts_rad, default=None)),
    }


def _format_number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
