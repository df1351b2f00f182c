"""Runs the trials of a suite, stores each outcome, prints the table and writes the page."""

import secrets
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import raise_on_stop_signals
from snakesim_hal.base.step_limit import SharedStepTimes
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.base.dask_cluster import validate_address
from snakesim_operator.features.evaluate import store
from snakesim_operator.features.evaluate.condition_results import (
    ConditionResults,
    find_best_controller,
    find_worst_failures,
    group_outcomes_by_condition,
)
from snakesim_operator.features.evaluate.page import TrialFailure, render_evaluation_page
from snakesim_operator.features.evaluate.progress import TrialProgress
from snakesim_operator.features.evaluate.score_card import (
    CARD_FILENAME,
    ScoreCard,
    compare_cards,
    format_card,
    make_card,
    read_card,
)
from snakesim_operator.features.evaluate.suite import EvaluationSuite
from snakesim_operator.features.evaluate.table import format_table
from snakesim_operator.features.evaluate.trial import EvaluationTrial
from snakesim_operator.features.evaluate.trial_list import (
    find_trial,
    format_trial_name,
    make_trials,
    select_trials_of_conditions,
)
from snakesim_operator.features.evaluate.workers import start_workers
from snakesim_operator.run.conclusion import EXIT_INTERRUPTED
from snakesim_operator.run.folder import choose_default_folder
from snakesim_operator.run.in_process import run_in_process

# New seeds are chosen beyond any that parameters were tuned on.
FIRST_NEW_SEED = 1_000_000
LAST_NEW_SEED = 2_000_000_000
PAGE_FILENAME = "evaluation.html"


@dataclass(frozen=True)
class EvaluationRequest:
    """The request of the command line."""

    # Trials.
    suite: EvaluationSuite
    source: str  # the suite's file, or the command that takes the place of one
    name: str
    controllers: Sequence[str]  # if empty, that of the scenario
    seeds: int  # number of seeds for each condition and controller
    seed: int | None = None  # the first seed; None: 1, or a new one if the suite asks for new seeds
    conditions: Sequence[int] = ()  # by number; if empty, all
    trial: str | None = None  # name of the one trial to run
    # Results.
    command: str = ""  # the command that runs one trial, without `--trial`
    against: Sequence[Path] = ()  # score cards of other evaluations
    out: Path | None = None
    resume: bool = False
    # Workers.
    cluster: str | None = None
    workers: int | None = None


def run_evaluation(request: EvaluationRequest, step_times: SharedStepTimes | None = None) -> int:
    """Run all trials of an evaluation that have no outcome yet, or one trial as a run with its own folder.

    Args:
        request: The trials, the output folder, and the options of the command.
        step_times: Shared memory that shows another process that a single run makes progress; None if no process
            watches.

    Returns:
        The exit code: 0 if all trials ran; 1 if a trial could not run; 130 if the user stopped it. Finished trials are
        never lost.
    """
    if request.trial is not None:
        return _run_one_trial(request, request.trial, step_times)
    with raise_on_stop_signals():
        try:
            return _run_all_trials(request)
        except KeyboardInterrupt:
            print_line("stopped before the first trial began")
            return EXIT_INTERRUPTED


def _run_all_trials(request: EvaluationRequest) -> int:
    """Run all trials that have no outcome in the output folder yet, and write the report of all trials.

    Args:
        request: The trials, the output folder, and the options of the command.

    Returns:
        The exit code: 0 if all trials ran; 1 if a trial could not run; EXIT_INTERRUPTED if the user stopped it.

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
    trials = make_trials(
        request.suite, request.source, request.controllers, request.seeds, first_seed
    )
    trials = select_trials_of_conditions(trials, request.conditions, request.source)
    output_folder = request.out or choose_default_folder(request.name)
    with store.open_store(output_folder, resume=request.resume) as results:
        trials_to_run = _select_trials_to_run(trials, results.outcome_by_id)
        if request.resume:
            finished_count = len(trials) - len(trials_to_run)
            print_line(f"{finished_count} of {len(trials)} trials are finished already")
        try:
            if trials_to_run:
                _run_and_store_trials(request, trials_to_run, results, output_folder)
            _report_results(request, trials, results.outcome_by_id, output_folder, other_cards)
        except KeyboardInterrupt:
            finished_count = sum(trial.id in results.outcome_by_id for trial in trials)
            print_line(
                f"stopped: {finished_count} of {len(trials)} trials are finished; the same command continues with"
            )
            seed_option = f" --seed {first_seed}" if request.suite.new_seeds else ""
            print_line(f"  --resume --out {shlex.quote(str(output_folder))}{seed_option}")
            return EXIT_INTERRUPTED
        has_errors = any(results.outcome_by_id[trial.id].error is not None for trial in trials)
        return 1 if has_errors else 0


def choose_first_seed(request: EvaluationRequest) -> int:
    """Choose the first seed, and print it if it is a new one.

    It is the requested number, a random number if the suite asks for new seeds, or 1.

    Args:
        request: The options of the evaluation, with the suite.

    Returns:
        The first seed; each following seed is the next number.

    Raises:
        ConfigError: An evaluation is resumed, and it is not known which new seeds it has chosen.
    """
    if request.seed is not None:
        return request.seed
    if not request.suite.new_seeds:
        return 1
    if request.resume:
        raise ConfigError(
            "--resume: this suite chooses new seeds; give the first seed of the evaluation, which it has printed, "
            "with --seed",
            code="command/invalid-option",
        )
    seed = secrets.randbelow(LAST_NEW_SEED - FIRST_NEW_SEED) + FIRST_NEW_SEED
    print_line(
        f"new seeds {seed} to {seed + request.seeds - 1}; --seed {seed} repeats the evaluation with them"
    )
    return seed


def _select_trials_to_run(
    trials: Sequence[EvaluationTrial], outcome_by_id: store.OutcomeById
) -> list[EvaluationTrial]:
    """Return the trials without an outcome, in the order in which they are run.

    Trials of two conditions with the same configuration have the same id, and run once. All conditions run with the
    first seed, then with the next one, so that every condition has results of the same seeds if the user stops it.
    """
    missing_trial_by_id = {trial.id: trial for trial in trials if trial.id not in outcome_by_id}
    return sorted(missing_trial_by_id.values(), key=lambda trial: trial.seed)


def _run_one_trial(
    request: EvaluationRequest, name: str, step_times: SharedStepTimes | None
) -> int:
    """Run one trial in this process, with the whole folder of a run. Return the exit code of `snakesim run`."""
    trial = find_trial(request.suite, request.source, name)
    print_line(f"{trial.condition_name}, {trial.controller}, seed {trial.seed}")
    config = msgspec.json.decode(trial.config, type=RunConfig)
    return run_in_process(
        config,
        request.out,
        until_goal=True,
        stall_timeout_s=trial.stall_timeout_s,
        step_times=step_times,
    )


def _run_and_store_trials(
    request: EvaluationRequest,
    trials: Sequence[EvaluationTrial],
    results: store.ResultStore,
    output_folder: Path,
) -> None:
    """Run trials on workers, and store each outcome at once."""
    with (
        start_workers(request.cluster, request.workers) as pool,
        TrialProgress(len(trials)) as progress,
    ):
        location = request.cluster or "on this computer"
        print_line(f"{len(trials)} trials on {pool.count_workers()} workers, {location}")
        print_line(
            f"results: {output_folder}; if this ends early, --resume --out {output_folder} continues"
        )
        for trial, outcome in pool.run_trials(trials):
            results.append(trial, outcome)
            progress.count_outcome(outcome)


def _report_results(
    request: EvaluationRequest,
    trials: Sequence[EvaluationTrial],
    outcome_by_id: store.OutcomeById,
    output_folder: Path,
    other_cards: Sequence[ScoreCard],
) -> None:
    """Print the table of results and the worst failures, and write tables, score card and page.

    Args:
        request: The options of the evaluation.
        trials: All trials, in the order of the table.
        outcome_by_id: The outcome of each trial by its id.
        output_folder: The output folder.
        other_cards: Score cards of other evaluations to compare with.
    """
    results = group_outcomes_by_condition(trials, outcome_by_id)
    _print_table(results)
    _print_errors(trials, outcome_by_id)

    best_controller = find_best_controller(results)
    trials_of_best = [trial for trial in trials if trial.controller == best_controller]
    failures = _list_worst_failures(request, trials_of_best, outcome_by_id)
    _print_failures(best_controller, failures)

    table_paths = store.write_tables(output_folder, trials, outcome_by_id)
    card = make_card(request.name, trials, outcome_by_id)
    # The card is printed only if it is used for a comparison: on new seeds, or with other cards.
    if request.suite.new_seeds or other_cards:
        for line in format_card(card, compare_cards(card, other_cards)):
            print_line(line)
    card_path = output_folder / CARD_FILENAME
    page_path = output_folder / PAGE_FILENAME
    title = request.suite.title or request.name
    write_text(card_path, msgspec.json.format(msgspec.json.encode(card), indent=1).decode())
    write_text(page_path, render_evaluation_page(title, request.source, results, failures))
    for path in (*table_paths, card_path, page_path):
        print_line(f"written: {path}")


def _print_table(results: Sequence[ConditionResults]) -> None:
    """Print the table of results, and how to get intervals if a row has none."""
    for line in format_table(results):
        print_line(line)
    # A condition without a goal has no success rate. Its interval is that of the mean over its trials.
    has_no_interval = any(
        condition_results.trial_count == 1 and condition_results.success_count is None
        for condition_results in results
    )
    if has_no_interval:
        print_line("a condition with one trial has no interval; give --seeds 2 or more")


def _print_errors(trials: Sequence[EvaluationTrial], outcome_by_id: store.OutcomeById) -> None:
    """Print how many trials could not run, and why the first of them could not."""
    trials_with_error = [trial for trial in trials if outcome_by_id[trial.id].error is not None]
    if trials_with_error:
        first_trial = trials_with_error[0]
        print_line(
            f"{len(trials_with_error)} could not run, the first: {format_trial_name(first_trial)}: "
            f"{outcome_by_id[first_trial.id].error}"
        )


def _list_worst_failures(
    request: EvaluationRequest,
    trials: Sequence[EvaluationTrial],
    outcome_by_id: store.OutcomeById,
) -> list[TrialFailure]:
    failures: list[TrialFailure] = []
    for trial, reason in find_worst_failures(trials, outcome_by_id):
        trial_name = format_trial_name(trial)
        failures.append(
            TrialFailure(
                name=f"{trial.condition_name}, {trial_name}",
                reason=reason,
                command=f"{request.command} --trial {shlex.quote(trial_name)}",
            )
        )
    return failures


def _print_failures(controller: str, failures: Sequence[TrialFailure]) -> None:
    if len(failures) > 1:
        print_line(f"the worst {len(failures)} trials of {controller}:")
    elif failures:
        print_line(f"the worst trial of {controller}:")
    for failure in failures:
        print_line(f"  {failure.name}: {failure.reason}")
        print_line(f"    {failure.command}")
