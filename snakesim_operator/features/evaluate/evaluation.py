"""Runs the cases of a suite, stores what is done, prints the table and draws the page."""

import re
import secrets
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.base.process import stop_signals_raise
from snakesim_hal.base.step_limit import Pulse
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.base.dask_cluster import check_address
from snakesim_operator.features.evaluate import store
from snakesim_operator.features.evaluate.card import CARD, Card, card_lines, compare, make_card, read_card
from snakesim_operator.features.evaluate.case import Case
from snakesim_operator.features.evaluate.cluster import workers
from snakesim_operator.features.evaluate.page import render_page
from snakesim_operator.features.evaluate.progress import Progress
from snakesim_operator.features.evaluate.suite import Suite, make_cases, select_rows
from snakesim_operator.features.evaluate.table import best_controller, group_results, table_lines, worst_failures
from snakesim_operator.run.conclusion import INTERRUPTED
from snakesim_operator.run.folder import default_folder
from snakesim_operator.run.in_process import run_in_process

FIRST_DRAWN_FIELD = 1_000_000  # fields that a suite draws are beyond any that parameters were tuned on
LAST_DRAWN_FIELD = 2_000_000_000
PAGE = "evaluation.html"


@dataclass(frozen=True)
class EvaluationRequest:
    """The request of the command line."""

    # Cases.
    suite: Suite
    source: str  # the suite's file, or the command that stands for one
    name: str
    controllers: Sequence[str]  # none: that of the scenario
    fields: int
    seed: int | None = None  # number of the first field; None: 1, or drawn by the suite
    rows: Sequence[int] = ()  # none: all
    only: str | None = None  # the one case to run
    # Results.
    command: str = ""  # the command that runs one case, without `--only`
    against: Sequence[Path] = ()  # score cards of other evaluations
    out: Path | None = None
    resume: bool = False
    # Workers.
    cluster: str | None = None
    workers: int | None = None


def evaluate(request: EvaluationRequest, pulse: Pulse | None = None) -> int:
    """Run all cases of an evaluation that have no result yet, or one case as a run with its own folder.

    Args:
        request: the cases, the output folder, and the options of the command.
        pulse: shows another process that a single run makes progress; None if no process watches.

    Returns:
        The exit code: 0; 1 if a case could not run; 130 if the operator stopped it. Finished cases are never lost.
    """
    if request.only is not None:
        return _run_one_case(request, request.only, pulse)
    with stop_signals_raise():
        try:
            return _run_all_cases(request)
        except KeyboardInterrupt:
            print_line("stopped before any case was begun")
            return INTERRUPTED


def _run_all_cases(request: EvaluationRequest) -> int:
    """Run all cases that have no result in the output folder yet, and write the results.

    Returns:
        The exit code: 0; 1 if a case could not run; INTERRUPTED if the operator stopped it.

    Raises:
        ConfigError: The request is invalid.
    """
    if request.resume and request.out is None:
        raise ConfigError("--resume: name the folder of the evaluation with --out", code="command/invalid-option")
    check_address(request.cluster)
    other_cards = [read_card(path) for path in request.against]
    seed = choose_first_field(request)
    cases = make_cases(request.suite, request.source, request.controllers, request.fields, seed)
    cases = select_rows(cases, request.rows, request.source)
    out = request.out or default_folder(request.name)
    with store.open_store(out, resume=request.resume) as results:
        # Cases of two rows with the same configuration have the same id, and run once.
        cases_to_run = list({case.id: case for case in cases if case.id not in results.done}.values())
        cases_to_run.sort(key=lambda case: case.field)  # if it is stopped, every row has results of the same fields
        if request.resume:
            print_line(f"{len(cases) - len(cases_to_run)} of {len(cases)} cases are done already")
        try:
            if cases_to_run:
                _run_on_workers(request, cases_to_run, results, out)
            _report(request, cases, results.done, out, other_cards)
        except KeyboardInterrupt:
            done_count = sum(case.id in results.done for case in cases)
            print_line(f"stopped: {done_count} of {len(cases)} cases are done; the same command continues with")
            seed_option = f" --seed {seed}" if request.suite.fresh else ""
            print_line(f"  --resume --out {shlex.quote(str(out))}{seed_option}")
            return INTERRUPTED
        has_errors = any(results.done[case.id].error is not None for case in cases)
        return 1 if has_errors else 0


def choose_first_field(request: EvaluationRequest) -> int:
    """Return the number of the first field, that is the seed of the first random scene.

    It is the requested number, a random number now if the suite asks for new fields, or 1.

    Args:
        request: the options of the evaluation, with the suite.

    Raises:
        ConfigError: an evaluation is resumed, and it is not known which fields were drawn.
    """
    if request.seed is not None:
        return request.seed
    if not request.suite.fresh:
        return 1
    if request.resume:
        raise ConfigError(
            "--resume: this suite draws its fields; name with --seed those that were printed as drawn",
            code="command/invalid-option",
        )
    seed = secrets.randbelow(LAST_DRAWN_FIELD - FIRST_DRAWN_FIELD) + FIRST_DRAWN_FIELD
    print_line(f"fields {seed} to {seed + request.fields - 1}, drawn now; --seed {seed} takes them again")
    return seed


def _run_one_case(request: EvaluationRequest, only: str, pulse: Pulse | None) -> int:
    """Run one case in this process, with the whole folder of a run. Return the exit code of `snakesim run`."""
    case = find_case(request.suite, request.source, only)
    print_line(f"{case.setting}, {case.controller}, field {case.field}")
    config = msgspec.json.decode(case.config, type=RunConfig)
    return run_in_process(config, request.out, until_goal=True, give_up_s=case.give_up_s, pulse=pulse)


def find_case(suite: Suite, source: str, only: str) -> Case:
    """Return the case of CONTROLLER:FIELD:ROW, or of CONTROLLER:FIELD if there is one row. Raises ConfigError."""
    parts = re.fullmatch(r"(?P<controller>.+?):(?P<field>\d{1,10})(:(?P<row>\d{1,6}))?", only)
    if parts is None:
        raise ConfigError(
            f"--only {shorten(only)}: give CONTROLLER:FIELD or CONTROLLER:FIELD:ROW, such as hold:3:1",
            code="command/invalid-option",
        )
    cases = make_cases(suite, source, [parts["controller"]], 1, int(parts["field"]))
    matching = [case for case in cases if parts["row"] is None or case.row == int(parts["row"])]
    if len(matching) == 1:
        return matching[0]
    rows = ", ".join(f"{case.row} ({case.setting})" for case in cases[:12])
    raise ConfigError(
        f"--only {only}: add one of the rows, as in {name_case(cases[0])}; there are {rows}",
        code="command/invalid-option",
    )


def name_case(case: Case) -> str:
    """Return the name of a case as `--only` accepts it."""
    return f"{case.controller}:{case.field}:{case.row}"


def _run_on_workers(request: EvaluationRequest, todo: Sequence[Case], results: store.ResultStore, out: Path) -> None:
    """Run cases on workers, and store each as it is done."""
    with workers(request.cluster, request.workers) as pool, Progress(len(todo)) as progress:
        where = request.cluster or "on this computer"
        print_line(f"{len(todo)} cases on {pool.size()} workers, {where}")
        print_line(f"results: {out}; if this ends early, --resume --out {out} continues")
        for case, outcome in pool.solve(todo):
            results.append(case, outcome)
            progress.count(outcome)


def _report(
    request: EvaluationRequest, cases: Sequence[Case], done: store.Results, out: Path, other_cards: Sequence[Card]
) -> None:
    """Print the table of results and the worst failures, and write tables, score card and page.

    Args:
        request: The options of the evaluation.
        cases: All cases, in the order of the table.
        done: The outcome of each case by its id.
        out: The output folder.
        other_cards: Score cards of other evaluations to compare with.
    """
    rows = group_results(cases, done)
    for line in table_lines(rows):
        print_line(line)
    if any(row.runs == 1 and row.crossed is None for row in rows):
        print_line("a row of one run has no interval; give --seeds 2 or more (of a suite --fields)")
    _print_errors(cases, done)

    best = best_controller(rows)
    cases_of_best = [case for case in cases if case.controller == best]
    failures = _find_failures(request, cases_of_best, done)
    _print_failures(best, failures)

    table_paths = store.write_tables(out, cases, done)
    card = make_card(request.name, cases, done)
    if request.suite.fresh or other_cards:
        for line in card_lines(card, compare(card, other_cards)):
            print_line(line)
    card_path = out / CARD
    page_path = out / PAGE
    title = request.suite.title or request.name
    write_text(card_path, msgspec.json.format(msgspec.json.encode(card), indent=1).decode())
    write_text(page_path, render_page(title, request.source, rows, failures))
    for path in (*table_paths, card_path, page_path):
        print_line(f"written: {path}")


def _print_errors(cases: Sequence[Case], done: store.Results) -> None:
    """Print how many cases could not run, and why the first of them could not."""
    broken = [case for case in cases if done[case.id].error is not None]
    if broken:
        first = broken[0]
        print_line(f"{len(broken)} could not run, the first: {name_case(first)}: {done[first.id].error}")


def _find_failures(
    request: EvaluationRequest, cases: Sequence[Case], done: store.Results
) -> list[tuple[str, str, str]]:
    """Return the worst failures, each with its name, how it ended, and the command that runs it again."""
    failures: list[tuple[str, str, str]] = []
    for case, reason in worst_failures(cases, done):
        name = name_case(case)
        failures.append((f"{case.setting}, {name}", reason, f"{request.command} --only {shlex.quote(name)}"))
    return failures


def _print_failures(controller: str, failures: Sequence[tuple[str, str, str]]) -> None:
    if len(failures) > 1:
        print_line(f"the worst {len(failures)} of {controller}:")
    elif failures:
        print_line(f"the worst of {controller}:")
    for name, reason, command in failures:
        print_line(f"  {name}: {reason}")
        print_line(f"    {command}")
