"""`snakesim study optimize`: searches settings for the best mean of a number, with Optuna. A file keeps all trials."""

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
from optuna.trial import Trial, TrialState

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import compose_config_table, parse_set_option
from snakesim_operator.base.dask_cluster import validate_address
from snakesim_operator.features.evaluate.case import (
    GAVE_UP_FIELD,
    CaseOutcome,
    EvaluationCase,
    compute_code_digest,
)
from snakesim_operator.features.evaluate.cluster import CaseWorkers, start_workers
from snakesim_operator.features.evaluate.search_file import (
    IS_STUCK_ATTRIBUTE,
    TRIAL_NUMBER_ATTRIBUTE,
    TRIAL_RESULTS_ATTRIBUTE,
    SearchCommand,
    generate_unused_trial_numbers,
    hash_configurations,
    open_study,
)
from snakesim_operator.features.evaluate.suite import (
    EvaluationSuite,
    list_seed_keys,
    make_cases,
    read_suite,
    select_cases_of_rows,
    set_suite_values,
)
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.progress import format_duration

ParameterRange = FloatDistribution | IntDistribution


@dataclass(frozen=True)
class SearchRequest:
    """The request of the command line."""

    scenario: str  # a suite's name, if rows are set
    vary: Sequence[str]  # key=low:high
    set: Sequence[str]  # key=value
    goal: str
    minimize: bool
    trials: int
    seeds: int
    seed: int
    storage: Path  # SQLite
    cluster: str | None = None
    workers: int | None = None
    rows: Sequence[int] = ()  # of the suite


def run_optimization(request: SearchRequest) -> int:
    """Search the values of keys that give the best metric, and print the best trial.

    All trials are stored in a file. A later search with the same options continues with them, and runs only those that
    are missing.

    Args:
        request: The keys with their ranges, the metric to optimize, and the options of the command.

    Returns:
        The exit code: 0, or 1 if no trial has a result.

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
    cases_at_ends = _make_trial_cases(
        request, {key: value_range.low for key, value_range in range_by_key.items()}
    )
    cases_at_ends += _make_trial_cases(
        request, {key: value_range.high for key, value_range in range_by_key.items()}
    )
    validate_address(request.cluster)
    study = open_study(request.storage, _make_search_command(request, range_by_key, cases_at_ends))
    study.sampler = optuna.samplers.TPESampler(
        seed=request.seed + len(study.trials), constant_liar=True
    )
    completed_count = len(study.get_trials(states=(TrialState.COMPLETE,)))
    storage_state = (
        f"holds {completed_count} trials already" if completed_count else "keeps all trials"
    )
    print_line(
        f"{request.storage} {storage_state}; --storage {shlex.quote(str(request.storage))} continues with them"
    )
    if request.trials > completed_count:
        _run_search(request, study, range_by_key, request.trials - completed_count)
    return _report_best(request, study)


def _run_search(
    request: SearchRequest,
    study: Study,
    range_by_key: Mapping[str, ParameterRange],
    trial_count: int,
) -> None:
    """Run trials in batches of as many as there are workers, and print the progress after each batch.

    Args:
        request: The options of the search.
        study: Proposes the values of each trial, and stores its result.
        range_by_key: The range of each varied key.
        trial_count: Number of trials to run.
    """
    start_s = time.monotonic()
    remaining_count = trial_count
    trial_numbers = generate_unused_trial_numbers(study)
    with start_workers(request.cluster, request.workers) as pool:
        while remaining_count > 0:
            batch: list[Trial] = []
            for trial_number in islice(trial_numbers, min(remaining_count, pool.count_workers())):
                # The copy has the type that Optuna declares: a dict of any distributions.
                trial = study.ask(dict[str, BaseDistribution](range_by_key))
                trial.set_user_attr(TRIAL_NUMBER_ATTRIBUTE, trial_number)
                batch.append(trial)
            _run_trials(request, study, batch, pool)
            remaining_count -= len(batch)
            done_count = trial_count - remaining_count
            elapsed_s = time.monotonic() - start_s
            remaining_s = elapsed_s / done_count * remaining_count
            elapsed = format_duration(elapsed_s)
            print_line(
                f"{done_count} of {trial_count} trials, {elapsed} passed, about {format_duration(remaining_s)} left"
            )


def _make_search_command(
    request: SearchRequest,
    range_by_key: Mapping[str, ParameterRange],
    cases_at_ends: Sequence[EvaluationCase],
) -> SearchCommand:
    """Collect everything on which the results of trials depend; workers and the number of trials are not included.

    Scenario, robot and scene files are part of it by a hash of complete configurations. Those at the two ends of the
    ranges are enough: the configurations of all other trials differ from them in the varied keys only.

    Args:
        request: The options of the search.
        range_by_key: The range of each varied key.
        cases_at_ends: The cases of two trials, in which all varied keys have their lowest or their highest values.
    """
    return SearchCommand(
        scenario=request.scenario,
        rows=list(request.rows),
        vary={
            key: f"{value_range.low!r}:{value_range.high!r}"
            for key, value_range in range_by_key.items()
        },
        set=_parse_set_options(request),  # the values, which are compared
        set_words=list(
            request.set
        ),  # the options as they were typed, for the command that continues the search
        goal=request.goal,
        direction="minimize" if request.minimize else "maximize",
        seeds=request.seeds,  # number of random scenes for each trial
        seed=request.seed,  # the first of them
        configurations=hash_configurations(cases_at_ends),
        code=compute_code_digest(),
    )


def _run_trials(
    request: SearchRequest, study: Study, trials: Sequence[Trial], pool: CaseWorkers
) -> None:
    """Run all cases of these trials, store the result of each trial in the study, and print it."""
    cases_by_trial = {trial.number: _make_trial_cases(request, trial.params) for trial in trials}
    unique_cases = {case.id: case for cases in cases_by_trial.values() for case in cases}
    outcomes: dict[str, CaseOutcome] = {}
    for case, outcome in pool.run_cases(list(unique_cases.values())):
        outcomes[case.id] = outcome
    for trial in trials:
        _store_result(
            request, study, trial, [outcomes[case.id] for case in cases_by_trial[trial.number]]
        )


def _store_result(
    request: SearchRequest, study: Study, trial: Trial, outcomes: Sequence[CaseOutcome]
) -> None:
    """Store the mean of a trial's metric in the study, or that the trial failed if a run has none, and print it."""
    values = [outcome.numbers.get(request.goal) for outcome in outcomes]
    known_values = [
        float(goal_value) for goal_value in values if isinstance(goal_value, int | float)
    ]
    parameters = ", ".join(f"{key} {value:.4g}" for key, value in trial.params.items())
    label = f"trial {trial.user_attrs[TRIAL_NUMBER_ATTRIBUTE]}: {parameters}"
    if len(known_values) < len(values):
        reason = next((outcome.error for outcome in outcomes if outcome.error), "unknown")
        study.tell(trial, state=TrialState.FAIL)
        print_line(f"{label}: no {request.goal}: {reason}")
        return
    trial.set_user_attr(TRIAL_RESULTS_ATTRIBUTE, known_values)
    trial.set_user_attr(IS_STUCK_ATTRIBUTE, bool(outcomes[0].numbers.get(GAVE_UP_FIELD)))
    study.tell(trial, float(np.mean(known_values)))
    print_line(f"{label}: {np.mean(known_values):.4g}")


def _report_best(request: SearchRequest, study: Study) -> int:
    """Print the best trial of a search, and the command that repeats it.

    Args:
        request: The options of the search.
        study: The trials with their results.

    Returns:
        The exit code: 0, or 1 if no trial has a result.
    """
    metric = request.goal
    set_options = request.set
    if not study.get_trials(states=(TrialState.COMPLETE,)):
        print_line(f"no trial had a {metric}")
        return 1
    best_trial = study.best_trial
    print_line(
        f"best {metric}: {best_trial.value:.4g}, trial {best_trial.user_attrs[TRIAL_NUMBER_ATTRIBUTE]}"
    )
    if request.rows:  # the trial evaluated rows of a suite
        rows = ",".join(map(str, request.rows))
        command = ["snakesim", "study", "evaluate", request.scenario, "--rows", rows]
        print_line(f"  {_format_command_line(command, set_options, best_trial.params)}")
        return 0
    results = best_trial.user_attrs[TRIAL_RESULTS_ATTRIBUTE]
    if len(results) > 1:
        print_line(
            f"  the mean of {len(results)} runs; the first of them, {results[0]:.4g}, again:"
        )
    if best_trial.user_attrs[IS_STUCK_ATTRIBUTE]:
        print_line(
            "  the search ended this run when it was stuck; this command runs it to its end, so its number may differ:"
        )
    config_table = compose_config_table(request.scenario, list(map(parse_set_option, set_options)))
    overrides = {**best_trial.params, **dict.fromkeys(list_seed_keys(config_table), request.seed)}
    command = ["snakesim", "run", request.scenario, "--clock-mode", "lockstep"]
    if config_table.values.get("mission", {}).get("goal"):
        command.append("--until-goal")  # without a goal it would be refused
    print_line(f"  {_format_command_line(command, set_options, overrides)}")
    return 0


def _format_command_line(
    words: Sequence[str], settings: Sequence[str], values: Mapping[str, Any]
) -> str:
    """Return a command with `--set` for each setting, as the user typed it, and for each value."""
    words = list(words)
    for setting in (*settings, *(f"{key}={value!r}" for key, value in values.items())):
        words += ["--set", setting]
    return shlex.join(words)


def _parse_set_options(request: SearchRequest) -> dict[str, Any]:
    """Return the values of `--set`, by key."""
    overrides = map(parse_set_option, request.set)
    return {override.key: override.value for override in overrides}


def _make_trial_cases(
    request: SearchRequest, parameter_values: dict[str, Any]
) -> list[EvaluationCase]:
    """Return the cases of a trial: each seed, in each requested row of a suite. Raises ConfigError."""
    if request.rows:
        suite, _ = read_suite(request.scenario)
    else:
        suite = EvaluationSuite(scenario=request.scenario)
    suite = set_suite_values(suite, {**_parse_set_options(request), **parameter_values})
    cases = make_cases(suite, "optimize", [], request.seeds, request.seed)
    return select_cases_of_rows(cases, request.rows, request.scenario)


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
