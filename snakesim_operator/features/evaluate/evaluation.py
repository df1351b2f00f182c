"""Runs the cases of a suite, stores what is done, prints the table and draws the page."""

import re
import secrets
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.base.process import raise_on_stop_signals
from snakesim_hal.base.step_limit import SharedStepTimes
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.base.dask_cluster import validate_address
from snakesim_operator.features.evaluate import store
from snakesim_operator.features.evaluate.card import (
    CARD_FILENAME,
    EvaluationCard,
    compare_cards,
    format_card,
    make_card,
    read_card,
)
from snakesim_operator.features.evaluate.case import EvaluationCase
from snakesim_operator.features.evaluate.cluster import start_workers
from snakesim_operator.features.evaluate.page import render_evaluation_page
from snakesim_operator.features.evaluate.progress import CaseProgress
from snakesim_operator.features.evaluate.suite import (
    EvaluationSuite,
    make_cases,
    select_cases_of_rows,
)
from snakesim_operator.features.evaluate.table import (
    ResultRow,
    find_best_controller,
    find_worst_failures,
    format_table,
    group_results_by_row,
)
from snakesim_operator.run.conclusion import EXIT_INTERRUPTED
from snakesim_operator.run.folder import choose_default_folder
from snakesim_operator.run.in_process import run_in_process

# Fields that a suite draws are beyond any that parameters were tuned on.
FIRST_DRAWN_FIELD = 1_000_000
LAST_DRAWN_FIELD = 2_000_000_000
PAGE_FILENAME = "evaluation.html"


@dataclass(frozen=True)
class EvaluationRequest:
    """The request of the command line."""

    # Cases.
    suite: EvaluationSuite
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


def run_evaluation(request: EvaluationRequest, step_times: SharedStepTimes | None = None) -> int:
    """Run all cases of an evaluation that have no result yet, or one case as a run with its own folder.

    Args:
        request: The cases, the output folder, and the options of the command.
        step_times: Shared memory that shows another process that a single run makes progress; None if no process
            watches.

    Returns:
        The exit code: 0 if all cases ran; 1 if a case could not run; 130 if the user stopped it. Finished cases are
        never lost.
    """
    if request.only is not None:
        return _run_one_case(request, request.only, step_times)
    with raise_on_stop_signals():
        try:
            return _run_all_cases(request)
        except KeyboardInterrupt:
            print_line("stopped before any case was begun")
            return EXIT_INTERRUPTED


def _run_all_cases(request: EvaluationRequest) -> int:
    """Run all cases that have no result in the output folder yet, and write the report of all cases.

    Args:
        request: The cases, the output folder, and the options of the command.

    Returns:
        The exit code: 0 if all cases ran; 1 if a case could not run; EXIT_INTERRUPTED if the user stopped it.

    Raises:
        ConfigError: The request is invalid.
    """
    if request.resume and request.out is None:
        raise ConfigError(
            "--resume: name the folder of the evaluation with --out", code="command/invalid-option"
        )
    validate_address(request.cluster)
    other_cards = [read_card(path) for path in request.against]
    first_seed = choose_first_seed(request)
    cases = make_cases(
        request.suite, request.source, request.controllers, request.fields, first_seed
    )
    cases = select_cases_of_rows(cases, request.rows, request.source)
    output_folder = request.out or choose_default_folder(request.name)
    with store.open_store(output_folder, resume=request.resume) as results:
        # Cases of two rows with the same configuration have the same id, and run once.
        cases_to_run = list(
            {case.id: case for case in cases if case.id not in results.done}.values()
        )
        # If it is stopped, every row has results of the same fields.
        cases_to_run.sort(key=lambda case: case.field)
        if request.resume:
            print_line(f"{len(cases) - len(cases_to_run)} of {len(cases)} cases are done already")
        try:
            if cases_to_run:
                _run_and_store_cases(request, cases_to_run, results, output_folder)
            _report_results(request, cases, results.done, output_folder, other_cards)
        except KeyboardInterrupt:
            done_count = sum(case.id in results.done for case in cases)
            print_line(
                f"stopped: {done_count} of {len(cases)} cases are done; the same command continues with"
            )
            seed_option = f" --seed {first_seed}" if request.suite.fresh else ""
            print_line(f"  --resume --out {shlex.quote(str(output_folder))}{seed_option}")
            return EXIT_INTERRUPTED
        has_errors = any(results.done[case.id].error is not None for case in cases)
        return 1 if has_errors else 0


def choose_first_seed(request: EvaluationRequest) -> int:
    """Choose the number of the first field, which is the seed of its random scene; print it if it was drawn now.

    It is the requested number, a random number if the suite asks for new fields, or 1.

    Args:
        request: The options of the evaluation, with the suite.

    Returns:
        The number of the first field; each following field has the next number.

    Raises:
        ConfigError: An evaluation is resumed, and it is not known which fields were drawn.
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
    print_line(
        f"fields {seed} to {seed + request.fields - 1}, drawn now; --seed {seed} takes them again"
    )
    return seed


def _run_one_case(request: EvaluationRequest, only: str, step_times: SharedStepTimes | None) -> int:
    """Run one case in this process, with the whole folder of a run. Return the exit code of `snakesim run`."""
    case = find_case(request.suite, request.source, only)
    print_line(f"{case.setting}, {case.controller}, field {case.field}")
    config = msgspec.json.decode(case.config, type=RunConfig)
    return run_in_process(
        config,
        request.out,
        until_goal=True,
        stall_timeout_s=case.stall_timeout_s,
        step_times=step_times,
    )


def find_case(suite: EvaluationSuite, source: str, only: str) -> EvaluationCase:
    """Return the case of CONTROLLER:FIELD:ROW, or of CONTROLLER:FIELD if there is one row. Raises ConfigError."""
    match = re.fullmatch(r"(?P<controller>.+?):(?P<field>\d{1,10})(:(?P<row>\d{1,6}))?", only)
    if match is None:
        raise ConfigError(
            f"--only {shorten(only)}: give CONTROLLER:FIELD or CONTROLLER:FIELD:ROW, such as hold:3:1",
            code="command/invalid-option",
        )
    cases = make_cases(suite, source, [match["controller"]], 1, int(match["field"]))
    matching_cases = [
        case for case in cases if match["row"] is None or case.row == int(match["row"])
    ]
    if len(matching_cases) == 1:
        return matching_cases[0]
    rows = ", ".join(f"{case.row} ({case.setting})" for case in cases[:12])
    raise ConfigError(
        f"--only {only}: add one of the rows, as in {format_case_name(cases[0])}; there are {rows}",
        code="command/invalid-option",
    )


def format_case_name(case: EvaluationCase) -> str:
    """Return the name of a case as `--only` accepts it."""
    return f"{case.controller}:{case.field}:{case.row}"


def _run_and_store_cases(
    request: EvaluationRequest,
    cases: Sequence[EvaluationCase],
    results: store.ResultStore,
    output_folder: Path,
) -> None:
    """Run cases on workers, and store each as it is done."""
    with (
        start_workers(request.cluster, request.workers) as pool,
        CaseProgress(len(cases)) as progress,
    ):
        location = request.cluster or "on this computer"
        print_line(f"{len(cases)} cases on {pool.count_workers()} workers, {location}")
        print_line(
            f"results: {output_folder}; if this ends early, --resume --out {output_folder} continues"
        )
        for case, outcome in pool.run_cases(cases):
            results.append(case, outcome)
            progress.count_outcome(outcome)


def _report_results(
    request: EvaluationRequest,
    cases: Sequence[EvaluationCase],
    outcome_by_id: store.Results,
    output_folder: Path,
    other_cards: Sequence[EvaluationCard],
) -> None:
    """Print the table of results and the worst failures, and write tables, score card and page.

    Args:
        request: The options of the evaluation.
        cases: All cases, in the order of the table.
        outcome_by_id: The outcome of each case by its id.
        output_folder: The output folder.
        other_cards: Score cards of other evaluations to compare with.
    """
    rows = group_results_by_row(cases, outcome_by_id)
    _print_table(rows)
    _print_errors(cases, outcome_by_id)

    best_controller = find_best_controller(rows)
    cases_of_best = [case for case in cases if case.controller == best_controller]
    failures = _list_worst_failures(request, cases_of_best, outcome_by_id)
    _print_failures(best_controller, failures)

    table_paths = store.write_tables(output_folder, cases, outcome_by_id)
    card = make_card(request.name, cases, outcome_by_id)
    # The card is printed only if it is used for a comparison: on fresh fields, or with other cards.
    if request.suite.fresh or other_cards:
        for line in format_card(card, compare_cards(card, other_cards)):
            print_line(line)
    card_path = output_folder / CARD_FILENAME
    page_path = output_folder / PAGE_FILENAME
    title = request.suite.title or request.name
    write_text(card_path, msgspec.json.format(msgspec.json.encode(card), indent=1).decode())
    write_text(page_path, render_evaluation_page(title, request.source, rows, failures))
    for path in (*table_paths, card_path, page_path):
        print_line(f"written: {path}")


def _print_table(rows: Sequence[ResultRow]) -> None:
    """Print the table of results, and how to get intervals if it has rows without any."""
    for line in format_table(rows):
        print_line(line)
    # A row without a goal has no success rate. Its interval is that of the mean over its runs.
    if any(row.runs == 1 and row.success_count is None for row in rows):
        print_line("a row of one run has no interval; give --seeds 2 or more (of a suite --fields)")


def _print_errors(cases: Sequence[EvaluationCase], outcome_by_id: store.Results) -> None:
    """Print how many cases could not run, and why the first of them could not."""
    cases_with_error = [case for case in cases if outcome_by_id[case.id].error is not None]
    if cases_with_error:
        first_case = cases_with_error[0]
        print_line(
            f"{len(cases_with_error)} could not run, the first: {format_case_name(first_case)}: "
            f"{outcome_by_id[first_case.id].error}"
        )


def _list_worst_failures(
    request: EvaluationRequest, cases: Sequence[EvaluationCase], done: store.Results
) -> list[tuple[str, str, str]]:
    """Return the worst failures, each as name, reason, and the command that runs it again."""
    failures: list[tuple[str, str, str]] = []
    for case, reason in find_worst_failures(cases, done):
        name = format_case_name(case)
        failures.append(
            (f"{case.setting}, {name}", reason, f"{request.command} --only {shlex.quote(name)}")
        )
    return failures


def _print_failures(controller: str, failures: Sequence[tuple[str, str, str]]) -> None:
    if len(failures) > 1:
        print_line(f"the worst {len(failures)} of {controller}:")
    elif failures:
        print_line(f"the worst of {controller}:")
    for name, reason, command in failures:
        print_line(f"  {name}: {reason}")
        print_line(f"    {command}")
