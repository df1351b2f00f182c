"""docs/faults.md, made from the raw results."""

from collections.abc import Iterator
from pathlib import Path

from tests.faults.results import ROOT, Store
from tests.faults.row import TRIALS, Result, Row, judge
from tests.faults.table import HEADINGS, LEASE_MS, PERIOD_MS

PAGE = ROOT / "docs" / "faults.md"
COLUMNS = ("fault", "backend", "expected", "deadline", "median", "worst", "trials", "retried", "result", "recovery")

INTRODUCTION = """\
# The fault table

Made by `make faults`{when}; do not edit. Raw results of every trial: [`faults.json`](faults.json). One row again:
`python -m tests.faults --rows NAME --write`.

**How.** Each row injects a fault, measures, and asserts, at least 20 times on each backend. The robot is the 13-joint
snake of the shipped scenario `triplet` at 100 Hz in real time (T = {period:.0f} ms, lease {lease:.0f} ms), with host,
guidance, navigation and control as processes of their own; `can` is the CAN driver with emulated joint modules on a
virtual bus, if nothing else is said. The host is the product's own process in every row but those that say so.

**What the times are.** Upper bounds: from just before the injection until an observer has received the first setpoints
that are the host's own stop mode (`hal/applied` without a sequence). The observer is a process of its own, with
real-time priority where the system allows it. The lease counts from the last good command, and is looked at once a
period; so what must be done within the lease is done at most one period after its end.

**Retried.** How often a trial, or the arming that begins it, was made again because the robot had stopped by itself
before anything was injected: a machine that is busy, or emulated, misses leases. A dash: measured before this was
counted.

**Recovery.** After each trial an operator's `reset` and `arm` bring the robot back; a trial counts as recovered when
the controller's commands are applied again. *Step*: the largest change of an applied angle target from one tick to the
next in the 0.3 s after it (allowed: the speed limit times T, {speed:.3f} rad, or what keeps the target within
`max_step_rad` of the measured angle). *First*: the largest distance of a first angle target from the measured angle
(allowed: `max_step_rad`, {max_step} rad).

**Machines.** {machines}
"""


def write(store: Store, page: Path = PAGE) -> Path:
    """Write it; returns where."""
    page.write_text("\n".join(_lines(store.read())) + "\n", encoding="utf-8")
    return page


def _lines(results: dict[tuple[str, str], Result]) -> Iterator[str]:
    known = [r for (name, _), r in sorted(results.items())]
    machines = sorted({result.machine for result in known})
    days = sorted({result.when.split()[0] for result in known})
    yield INTRODUCTION.format(
        when=f", {' to '.join(dict.fromkeys((days[0], days[-1])))}" if days else "",
        period=PERIOD_MS,
        lease=LEASE_MS,
        speed=7.5 * PERIOD_MS / 1000,
        max_step=0.35,
        machines="; ".join(machines) + "." if machines else "None yet.",
    )
    yield from _summary(results)
    for heading in HEADINGS:
        yield f"## {heading.fault}\n"
        yield f"Safe behavior: {heading.expected}. Deadline: {heading.deadline}.\n"
        yield f"| {' | '.join(COLUMNS)} |"
        yield f"|{'---|' * len(COLUMNS)}"
        for row in heading.rows:
            for backend, measure in row.on.items():
                if isinstance(measure, str):
                    yield _line(row, backend, "-", "-", "-", "-", f"not applicable: {measure}", "-")
                else:
                    yield _measured(row, backend, results.get((row.name, backend)))
        yield ""
        for row in heading.rows:
            yield from _notes(row, results)
        yield ""
    yield from _when(known)


def _summary(results: dict[tuple[str, str], Result]) -> Iterator[str]:
    wanted = [(row, b) for h in HEADINGS for row in h.rows for b, m in row.on.items() if not isinstance(m, str)]
    done = [(row, results[row.name, b]) for row, b in wanted if (row.name, b) in results]
    met = sum(judge(row, result).met for row, result in done)
    others = f"{len(done) - met} not met, {len(wanted) - len(done)} not run"
    yield f"**{met} of {len(wanted)} measurements met**, {others}.\n"


def _measured(row: Row, backend: str, result: Result | None) -> str:
    if result is None:
        return _line(row, backend, "-", "-", "0", "-", "**not run**", "-")
    verdict = judge(row, result)
    median = "-" if verdict.median is None else f"{verdict.median:.3g} {row.unit}"
    worst = "-" if verdict.worst is None else f"{verdict.worst:.3g} {row.unit}"
    outcome = "met" if verdict.met else f"**not met**: {_escaped(verdict.why[:300])}"
    trials = str(len(result.trials))
    trials += "" if len(result.trials) >= max(TRIALS, row.least) else f" of {max(TRIALS, row.least)}"
    retried = "-" if result.retried is None else str(result.retried)
    return _line(row, backend, median, worst, trials, retried, outcome, _recovery(result))


def _notes(row: Row, results: dict[tuple[str, str], Result]) -> Iterator[str]:
    """What belongs beside a row, with the backend where they differ."""
    said: dict[str, list[str]] = {}
    for (name, backend), result in sorted(results.items()):
        if name == row.name:
            for note in result.notes:
                said.setdefault(note, []).append(backend)
    everywhere = sum(name == row.name for name, _ in results)
    for note, backends in said.items():
        where = "" if len(backends) == everywhere else f" on {' and '.join(backends)}"
        yield f"* `{row.name}`{where}: {note}."


def _recovery(result: Result) -> str:
    tried = [trial for trial in result.trials if trial.recovered is not None]
    if not tried:
        return "nothing to recover from"
    back = sum(trial.recovered is True for trial in tried)
    steps = [trial.step_rad for trial in tried if trial.step_rad is not None]
    firsts = [trial.first_rad for trial in tried if trial.first_rad is not None]
    text = f"{back} of {len(tried)}"
    return text + (f"; step {max(steps):.3f}, first {max(firsts):.3f} rad" if steps and firsts else "")


def _line(row: Row, backend: str, *cells: str) -> str:
    where = "sim and can" if backend == "both" else backend
    return f"| {' | '.join((f'{row.fault} (`{row.name}`)', where, row.expected, row.deadline, *cells))} |"


def _escaped(text: str) -> str:
    return text.replace("|", "/").replace("\n", " ")


def _when(known: list[Result]) -> Iterator[str]:
    yield "## When each was measured\n"
    yield "| row | backend | when | took | load before |"
    yield "|---|---|---|---|---|"
    for result in sorted(known, key=lambda r: (r.row, r.backend)):
        yield f"| `{result.row}` | {result.backend} | {result.when} | {result.took_s:.0f} s | {result.load:g} |"
    if known:
        yield f"\nNewest measurement: {max(result.when for result in known)}."
