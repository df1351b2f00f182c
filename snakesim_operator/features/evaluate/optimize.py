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
from snakesim_hal.model.scenario import compose_table, parse_set
from snakesim_operator.base.dask_cluster import check_address
from snakesim_operator.features.evaluate.case import GAVE_UP, Case, CaseOutcome, code_digest
from snakesim_operator.features.evaluate.cluster import Workers, workers
from snakesim_operator.features.evaluate.search_file import (
    NUMBER,
    RESULTS,
    STUCK,
    SearchCommand,
    free_numbers,
    hash_configurations,
    open_study,
)
from snakesim_operator.features.evaluate.suite import (
    Suite,
    make_cases,
    override_suite,
    read_suite,
    seed_keys,
    select_rows,
)
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.progress import format_duration

Span = FloatDistribution | IntDistribution


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


def optimize(request: SearchRequest) -> int:
    """Search the values of keys that give the best number, until enough trials have a result or have been tried.

    All trials are stored in a file, from which a later search with the same options continues.

    Args:
        request: the keys with their ranges, the number to optimize, and the options of the command.

    Returns:
        The exit code: 0; 1 if no trial has a result.

    Raises:
        ConfigError: the request is invalid, or the file is of another search.
    """
    space = dict(map(_parse_span, request.vary))
    if request.goal not in RunSummary.__struct_fields__:
        raise ConfigError(
            f"--goal {request.goal}: the summary of a run has no such number; it has path_distance_m, advance_m_s, ...",
            code="command/invalid-option",
        )
    # Both ends of all ranges are configured before anything is started, so that an invalid range is an error now.
    cases_at_ends = _cases_of_trial(request, {key: span.low for key, span in space.items()})
    cases_at_ends += _cases_of_trial(request, {key: span.high for key, span in space.items()})
    check_address(request.cluster)
    study = open_study(request.storage, _search_command(request, space, cases_at_ends))
    study.sampler = optuna.samplers.TPESampler(seed=request.seed + len(study.trials), constant_liar=True)
    completed = len(study.get_trials(states=(TrialState.COMPLETE,)))
    storage_state = f"holds {completed} trials already" if completed else "keeps all trials"
    print_line(f"{request.storage} {storage_state}; --storage {shlex.quote(str(request.storage))} continues with them")
    if request.trials > completed:
        _search(request, study, space, request.trials - completed)
    return _report_best(request, study)


def _search(request: SearchRequest, study: Study, space: Mapping[str, Span], trials: int) -> None:
    """Run trials in batches of as many as there are workers, and print the progress after each batch.

    Args:
        request: The options of the search.
        study: Proposes the values of each trial, and stores its result.
        space: The range of each varied key.
        trials: How many trials to run.
    """
    start_s = time.monotonic()
    remaining = trials
    numbers = free_numbers(study)
    with workers(request.cluster, request.workers) as pool:
        while remaining > 0:
            batch: list[Trial] = []
            for number in islice(numbers, min(remaining, pool.size())):
                trial = study.ask(dict[str, BaseDistribution](space))
                trial.set_user_attr(NUMBER, number)
                batch.append(trial)
            _run_trials(request, study, batch, pool)
            remaining -= len(batch)
            done_count = trials - remaining
            passed_s = time.monotonic() - start_s
            remaining_s = passed_s / done_count * remaining
            passed = format_duration(passed_s)
            print_line(f"{done_count} of {trials} trials, {passed} passed, about {format_duration(remaining_s)} left")


def _search_command(request: SearchRequest, space: Mapping[str, Span], cases_at_ends: Sequence[Case]) -> SearchCommand:
    """Return everything that decides what the trials' numbers mean; workers and the number of trials do not."""
    return SearchCommand(
        scenario=request.scenario,
        rows=list(request.rows),
        vary={key: f"{span.low!r}:{span.high!r}" for key, span in space.items()},
        set=_set_values(request),
        set_words=list(request.set),
        goal=request.goal,
        direction="minimize" if request.minimize else "maximize",
        seeds=request.seeds,
        seed=request.seed,
        configurations=hash_configurations(cases_at_ends),
        code=code_digest(),
    )


def _run_trials(request: SearchRequest, study: Study, trials: Sequence[Trial], pool: Workers) -> None:
    """Run all cases of these trials, store the result of each trial in the study, and print it."""
    cases_of_trial = {trial.number: _cases_of_trial(request, trial.params) for trial in trials}
    unique_cases = {case.id: case for cases in cases_of_trial.values() for case in cases}
    outcomes: dict[str, CaseOutcome] = {}
    for case, outcome in pool.solve(list(unique_cases.values())):
        outcomes[case.id] = outcome
    for trial in trials:
        _store_result(request, study, trial, [outcomes[case.id] for case in cases_of_trial[trial.number]])


def _store_result(request: SearchRequest, study: Study, trial: Trial, outcomes: Sequence[CaseOutcome]) -> None:
    """Store the result of a trial, or that it failed because a run has no number, and print it."""
    numbers = [outcome.numbers.get(request.goal) for outcome in outcomes]
    known = [float(number) for number in numbers if isinstance(number, int | float)]
    parameters = ", ".join(f"{key} {value:.4g}" for key, value in trial.params.items())
    label = f"trial {trial.user_attrs[NUMBER]}: {parameters}"
    if len(known) < len(numbers):
        reason = next((outcome.error for outcome in outcomes if outcome.error), "unknown")
        study.tell(trial, state=TrialState.FAIL)
        print_line(f"{label}: no {request.goal}: {reason}")
        return
    trial.set_user_attr(RESULTS, known)
    trial.set_user_attr(STUCK, bool(outcomes[0].numbers.get(GAVE_UP)))
    study.tell(trial, float(np.mean(known)))
    print_line(f"{label}: {np.mean(known):.4g}")


def _report_best(request: SearchRequest, study: Study) -> int:
    """Print the best trial of a search, and the command that repeats it.

    Args:
        request: the options of the search.
        study: the trials with their results.

    Returns:
        The exit code: 0; 1 if no trial has a result.
    """
    if not study.get_trials(states=(TrialState.COMPLETE,)):
        print_line(f"no trial had a {request.goal}")
        return 1
    best = study.best_trial
    print_line(f"best {request.goal}: {best.value:.4g}, trial {best.user_attrs[NUMBER]}")
    if request.rows:
        rows = ",".join(map(str, request.rows))
        command = ["snakesim", "study", "evaluate", request.scenario, "--rows", rows]
        print_line(f"  {_command_line(command, request.set, best.params)}")
        return 0
    results = best.user_attrs[RESULTS]
    if len(results) > 1:
        print_line(f"  the mean of {len(results)} runs; the first of them, {results[0]:.4g}, again:")
    if best.user_attrs[STUCK]:
        print_line(
            "  the search ended this run when it was stuck; this command runs it to its end, so its number may differ:"
        )
    table = compose_table(request.scenario, list(map(parse_set, request.set)))
    values = {**best.params, **dict.fromkeys(seed_keys(table), request.seed)}
    command = ["snakesim", "run", request.scenario, "--clock-mode", "lockstep"]
    if table.values.get("mission", {}).get("goal"):
        command.append("--until-goal")  # without a goal it would be refused
    print_line(f"  {_command_line(command, request.set, values)}")
    return 0


def _command_line(words: Sequence[str], settings: Sequence[str], values: Mapping[str, Any]) -> str:
    """Return a command with `--set` for each setting, as the user typed it, and for each value."""
    words = list(words)
    for setting in (*settings, *(f"{key}={value!r}" for key, value in values.items())):
        words += ["--set", setting]
    return shlex.join(words)


def _set_values(request: SearchRequest) -> dict[str, Any]:
    """Return the values of `--set`, by key."""
    overrides = map(parse_set, request.set)
    return {override.key: override.value for override in overrides}


def _cases_of_trial(request: SearchRequest, parameters: dict[str, Any]) -> list[Case]:
    """Return the cases of a trial: each seed, in each requested row of a suite. Raises ConfigError."""
    if request.rows:
        suite, _ = read_suite(request.scenario)
    else:
        suite = Suite(scenario=request.scenario)
    suite = override_suite(suite, {**_set_values(request), **parameters})
    cases = make_cases(suite, "optimize", [], request.seeds, request.seed)
    return select_rows(cases, request.rows, request.scenario)


def _parse_span(text: str) -> tuple[str, Span]:
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
