"""`snakesim study optimize`: searches values of keys that give the best mean of a metric, with Optuna.

A candidate is one value for each varied key. Its result is the mean of the metric over its trials: one for each seed,
in each requested condition of a suite. A file keeps all candidates. In Optuna, a candidate is called a trial.
"""

import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.study import Study
from optuna.trial import TrialState

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import compose_config_table, parse_set_option
from snakesim_operator.base.dask_cluster import validate_address
from snakesim_operator.features.evaluate.search_file import (
    CANDIDATE_NUMBER_ATTRIBUTE,
    CANDIDATE_RESULTS_ATTRIBUTE,
    IS_STALLED_ATTRIBUTE,
    SearchCommand,
    generate_unused_candidate_numbers,
    hash_configurations,
    open_study,
)
from snakesim_operator.features.evaluate.suite import (
    EvaluationSuite,
    read_suite,
    set_suite_values,
)
from snakesim_operator.features.evaluate.trial import (
    ENDED_BY_STALL_METRIC,
    EvaluationTrial,
    TrialOutcome,
    compute_code_digest,
)
from snakesim_operator.features.evaluate.trial_list import (
    list_seed_keys,
    make_trials,
    select_trials_of_conditions,
)
from snakesim_operator.features.evaluate.workers import TrialWorkers, start_workers
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.progress import format_duration

ParameterRange = FloatDistribution | IntDistribution


@dataclass(frozen=True)
class SearchRequest:
    """The request of the command line."""

    scenario: str  # name of a suite, if conditions are given
    vary: Sequence[str]  # key=low:high
    set: Sequence[str]  # key=value
    goal: str  # name of the metric
    minimize: bool
    candidates: int  # number of candidates in the file at the end
    seeds: int  # number of seeds for each candidate
    seed: int  # the first of them
    storage: Path  # SQLite
    cluster: str | None = None
    workers: int | None = None
    conditions: Sequence[int] = ()  # of the suite, by number


def run_optimization(request: SearchRequest) -> int:
    """Search the values of keys that give the best metric, and print the best candidate.

    All candidates are stored in a file. A later search with the same options continues with them, and runs only those
    that are missing.

    Args:
        request: The keys with their ranges, the metric to optimize, and the options of the command.

    Returns:
        The exit code: 0, or 1 if no candidate has a result.

    Raises:
        ConfigError: The request is invalid, or the file is of another search.
    """
    range_by_key = dict(map(_parse_range, request.vary))
    if request.goal not in RunSummary.__struct_fields__:
        raise ConfigError(
            f"--goal {request.goal}: the summary of a run has no such number; it has path_distance_m, advance_m_s, ...",
            code="command/invalid-option",
        )
    # Both ends of all ranges are configured before anything is started, so that an invalid range is an error now.
    lowest_values = {key: value_range.low for key, value_range in range_by_key.items()}
    highest_values = {key: value_range.high for key, value_range in range_by_key.items()}
    trials_at_ends = _make_candidate_trials(request, lowest_values)
    trials_at_ends += _make_candidate_trials(request, highest_values)
    validate_address(request.cluster)
    study = open_study(request.storage, _make_search_command(request, range_by_key, trials_at_ends))
    study.sampler = optuna.samplers.TPESampler(
        seed=request.seed + len(study.trials), constant_liar=True
    )
    completed_count = len(study.get_trials(states=(TrialState.COMPLETE,)))
    storage_state = "keeps all candidates"
    if completed_count:
        storage_state = f"holds {completed_count} candidates already"
    print_line(
        f"{request.storage} {storage_state}; --storage {shlex.quote(str(request.storage))} continues with them"
    )
    if request.candidates > completed_count:
        _run_search(request, study, range_by_key, request.candidates - completed_count)
    return _report_best(request, study)


def _run_search(
    request: SearchRequest,
    study: Study,
    range_by_key: Mapping[str, ParameterRange],
    candidate_count: int,
) -> None:
    """Run candidates in batches of as many as there are workers, and print the progress after each batch.

    Args:
        request: The options of the search.
        study: Proposes the values of each candidate, and stores its result.
        range_by_key: The range of each varied key.
        candidate_count: Number of candidates to run.
    """
    start_s = time.monotonic()
    remaining_count = candidate_count
    candidate_numbers = generate_unused_candidate_numbers(study)
    with start_workers(request.cluster, request.workers) as pool:
        while remaining_count > 0:
            batch: list[optuna.trial.Trial] = []
            batch_size = min(remaining_count, pool.count_workers())
            for candidate_number in islice(candidate_numbers, batch_size):
                # The copy has the type that Optuna declares: a dict of any distributions.
                candidate = study.ask(dict[str, BaseDistribution](range_by_key))
                candidate.set_user_attr(CANDIDATE_NUMBER_ATTRIBUTE, candidate_number)
                batch.append(candidate)
            _run_candidates(request, study, batch, pool)
            remaining_count -= len(batch)
            done_count = candidate_count - remaining_count
            elapsed_s = time.monotonic() - start_s
            remaining_s = elapsed_s / done_count * remaining_count
            print_line(
                f"{done_count} of {candidate_count} candidates, {format_duration(elapsed_s)} passed, "
                f"about {format_duration(remaining_s)} left"
            )


def _make_search_command(
    request: SearchRequest,
    range_by_key: Mapping[str, ParameterRange],
    trials_at_ends: Sequence[EvaluationTrial],
) -> SearchCommand:
    """Collect everything on which results depend; workers and the number of candidates are not included.

    Scenario, robot and scene files are part of it by a hash of complete configurations. Those at the two ends of the
    ranges are enough: the configurations of all other candidates differ from them in the varied keys only.

    Args:
        request: The options of the search.
        range_by_key: The range of each varied key.
        trials_at_ends: The trials of two candidates, in which all varied keys have their lowest or their highest
            values.
    """
    range_text_by_key = {
        key: f"{value_range.low!r}:{value_range.high!r}"
        for key, value_range in range_by_key.items()
    }
    return SearchCommand(
        scenario=request.scenario,
        conditions=list(request.conditions),
        vary=range_text_by_key,
        set=_parse_set_options(request),
        set_texts=list(request.set),
        goal=request.goal,
        direction="minimize" if request.minimize else "maximize",
        seeds=request.seeds,
        seed=request.seed,
        configurations=hash_configurations(trials_at_ends),
        code=compute_code_digest(),
    )


def _run_candidates(
    request: SearchRequest,
    study: Study,
    candidates: Sequence[optuna.trial.Trial],
    pool: TrialWorkers,
) -> None:
    """Run all trials of these candidates, store the result of each candidate in the study, and print it."""
    trials_by_candidate = {
        candidate.number: _make_candidate_trials(request, candidate.params)
        for candidate in candidates
    }
    unique_trials = {trial.id: trial for trials in trials_by_candidate.values() for trial in trials}
    outcome_by_id: dict[str, TrialOutcome] = {}
    for trial, outcome in pool.run_trials(list(unique_trials.values())):
        outcome_by_id[trial.id] = outcome
    for candidate in candidates:
        trials = trials_by_candidate[candidate.number]
        _store_result(request, study, candidate, [outcome_by_id[trial.id] for trial in trials])


def _store_result(
    request: SearchRequest,
    study: Study,
    candidate: optuna.trial.Trial,
    outcomes: Sequence[TrialOutcome],
) -> None:
    """Store the mean of a candidate's metric, or that it failed if a trial has no such metric, and print it."""
    values = [outcome.metrics.get(request.goal) for outcome in outcomes]
    known_values = [float(value) for value in values if isinstance(value, int | float)]
    parameters = ", ".join(f"{key} {value:.4g}" for key, value in candidate.params.items())
    label = f"candidate {candidate.user_attrs[CANDIDATE_NUMBER_ATTRIBUTE]}: {parameters}"
    if len(known_values) < len(values):
        reason = next((outcome.error for outcome in outcomes if outcome.error), "unknown")
        study.tell(candidate, state=TrialState.FAIL)
        print_line(f"{label}: no {request.goal}: {reason}")
        return
    has_stalled = bool(outcomes[0].metrics.get(ENDED_BY_STALL_METRIC))
    candidate.set_user_attr(CANDIDATE_RESULTS_ATTRIBUTE, known_values)
    candidate.set_user_attr(IS_STALLED_ATTRIBUTE, has_stalled)
    study.tell(candidate, float(np.mean(known_values)))
    print_line(f"{label}: {np.mean(known_values):.4g}")


def _report_best(request: SearchRequest, study: Study) -> int:
    """Print the best candidate of a search, and the command that repeats it.

    Args:
        request: The options of the search.
        study: The candidates with their results.

    Returns:
        The exit code: 0, or 1 if no candidate has a result.
    """
    if not study.get_trials(states=(TrialState.COMPLETE,)):
        print_line(f"no candidate had a {request.goal}")
        return 1
    best = study.best_trial
    print_line(
        f"best {request.goal}: {best.value:.4g}, candidate {best.user_attrs[CANDIDATE_NUMBER_ATTRIBUTE]}"
    )
    if request.conditions:
        _print_evaluate_command(request, best.params)
        return 0
    results = best.user_attrs[CANDIDATE_RESULTS_ATTRIBUTE]
    if len(results) > 1:
        print_line(
            f"  the mean of {len(results)} trials; to repeat the first one, with {results[0]:.4g}:"
        )
    if best.user_attrs[IS_STALLED_ATTRIBUTE]:
        print_line(
            "  the search ended this trial because the robot did not advance; this command runs to the end, so its "
            "number may differ:"
        )
    _print_run_command(request, best.params)
    return 0


def _print_evaluate_command(request: SearchRequest, parameter_values: Mapping[str, Any]) -> None:
    """Print the command that evaluates these values in the conditions of the search."""
    numbers = ",".join(map(str, request.conditions))
    command = ["snakesim", "study", "evaluate", request.scenario, "--conditions", numbers]
    print_line(f"  {_format_command_line(command, request.set, parameter_values)}")


def _print_run_command(request: SearchRequest, parameter_values: Mapping[str, Any]) -> None:
    """Print the command that runs these values with the first seed of the search."""
    table = compose_config_table(request.scenario, list(map(parse_set_option, request.set)))
    overrides = {**parameter_values, **dict.fromkeys(list_seed_keys(table), request.seed)}
    command = ["snakesim", "run", request.scenario, "--clock-mode", "lockstep"]
    if table.values.get("mission", {}).get("goal"):
        command.append("--until-goal")  # without a goal it would be refused
    print_line(f"  {_format_command_line(command, request.set, overrides)}")


def _format_command_line(
    command: Sequence[str], set_texts: Sequence[str], value_by_key: Mapping[str, Any]
) -> str:
    """Return a command with an option `--set` for each text, as the user typed it, and for each value."""
    words = list(command)
    value_texts = [f"{key}={value!r}" for key, value in value_by_key.items()]
    for text in (*set_texts, *value_texts):
        words += ["--set", text]
    return shlex.join(words)


def _parse_set_options(request: SearchRequest) -> dict[str, Any]:
    """Return the values of `--set`, by key."""
    overrides = map(parse_set_option, request.set)
    return {override.key: override.value for override in overrides}


def _make_candidate_trials(
    request: SearchRequest, parameter_values: dict[str, Any]
) -> list[EvaluationTrial]:
    """Return the trials of a candidate: each seed, in each requested condition of a suite. Raises ConfigError."""
    if request.conditions:
        suite, _ = read_suite(request.scenario)
    else:
        suite = EvaluationSuite(scenario=request.scenario)
    suite = set_suite_values(suite, {**_parse_set_options(request), **parameter_values})
    trials = make_trials(suite, "optimize", [], request.seeds, request.seed)
    return select_trials_of_conditions(trials, request.conditions, request.scenario)


def _parse_range(text: str) -> tuple[str, ParameterRange]:
    """Return key and range of `key=low:high`: of whole numbers if both ends are. Raises ConfigError."""
    key, _, bounds = (part.strip() for part in text.partition("="))
    try:
        low, high = bounds.split(":")
        if low.strip("-").isdecimal() and high.strip("-").isdecimal():
            return key, IntDistribution(int(low), int(high))
        return key, FloatDistribution(float(low), float(high))
    except ValueError:
        raise ConfigError(
            f"--vary {shorten(text)}: give key=low:high, such as control.propulsion_n=5:40",
            code="command/invalid-option",
        ) from None
