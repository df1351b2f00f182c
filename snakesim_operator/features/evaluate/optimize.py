"""`snakesim optimize`: searches settings for the best mean of a number, with Optuna; a file keeps all trials."""

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

from snakesim_hal.base.errors import ConfigError, short
from snakesim_hal.base.terminal import say
from snakesim_hal.model.scenario import compose, parse_set
from snakesim_operator.base.dask_cluster import check_address
from snakesim_operator.features.evaluate.case import GAVE_UP, Case, Outcome, code_digest
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
from snakesim_operator.features.evaluate.suite import Suite, also_set, cases_of, read_suite, rows_of, seeds_of
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.progress import in_minutes

Span = FloatDistribution | IntDistribution


@dataclass(frozen=True)
class Request:
    """What the command line asks for."""

    scenario: str  # a suite's name, where rows are given
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


def optimize(request: Request) -> int:
    """Search until so many trials have a result, or have been tried. Returns 0, or 1 when no trial has a result."""
    space = dict(map(_span, request.vary))
    if request.goal not in RunSummary.__struct_fields__:
        raise ConfigError(
            f"--goal {request.goal}: the summary of a run has no such number; it has path_distance_m, advance_m_s, ..."
        )
    cases_at_ends: list[Case] = []
    for end in ("low", "high"):  # before anything is started
        cases_at_ends += _cases(request, {key: getattr(one, end) for key, one in space.items()})
    check_address(request.cluster)
    study = open_study(request.storage, _search_command(request, space, cases_at_ends))
    study.sampler = optuna.samplers.TPESampler(seed=request.seed + len(study.trials), constant_liar=True)
    have = len(study.get_trials(states=(TrialState.COMPLETE,)))
    already = f"holds {have} trials already" if have else "keeps all trials"
    say(f"{request.storage} {already}; --storage {shlex.quote(str(request.storage))} goes on with them")
    if left := max(request.trials - have, 0):
        began, todo = time.monotonic(), left
        numbers = free_numbers(study)
        with workers(request.cluster, request.workers) as working:
            while left > 0:
                asked: list[Trial] = []
                for number in islice(numbers, min(left, working.size())):
                    trial = study.ask(dict[str, BaseDistribution](space))
                    trial.set_user_attr(NUMBER, number)
                    asked.append(trial)
                _run_trials(request, study, asked, working)
                left -= len(asked)
                passed_s = time.monotonic() - began
                left_s = passed_s / (todo - left) * left
                say(f"{todo - left} of {todo} trials, {in_minutes(passed_s)} passed, about {in_minutes(left_s)} left")
    return _conclude(request, study)


def _search_command(request: Request, space: Mapping[str, Span], cases_at_ends: Sequence[Case]) -> SearchCommand:
    """Returns what decides what the trials' numbers mean; workers and the number of trials do not."""
    return SearchCommand(
        scenario=request.scenario,
        rows=list(request.rows),
        vary={key: f"{limits.low!r}:{limits.high!r}" for key, limits in space.items()},
        set={one.key: one.value for one in map(parse_set, request.set)},
        set_words=list(request.set),
        goal=request.goal,
        direction="minimize" if request.minimize else "maximize",
        seeds=request.seeds,
        seed=request.seed,
        configurations=hash_configurations(cases_at_ends),
        code=code_digest(),
    )


def _run_trials(request: Request, study: Study, asked: Sequence[Trial], working: Workers) -> None:
    """Runs all cases of these trials, and tells the study and the user what came of each trial."""
    cases = {trial.number: _cases(request, trial.params) for trial in asked}
    outcomes: dict[str, Outcome] = {}
    for case, outcome in working.solve(list({case.id: case for own in cases.values() for case in own}.values())):
        outcomes[case.id] = outcome
    for trial in asked:
        values = [outcomes[case.id].numbers.get(request.goal) for case in cases[trial.number]]
        known = [float(value) for value in values if isinstance(value, int | float)]
        words = ", ".join(f"{key} {value:.4g}" for key, value in trial.params.items())
        number = trial.user_attrs[NUMBER]
        if len(known) < len(values):
            why = next((outcomes[case.id].error for case in cases[trial.number] if outcomes[case.id].error), "unknown")
            study.tell(trial, state=TrialState.FAIL)
            say(f"trial {number}: {words}: no {request.goal}: {why}")
        else:
            trial.set_user_attr(RESULTS, known)
            first_run = outcomes[cases[trial.number][0].id]
            trial.set_user_attr(STUCK, bool(first_run.numbers.get(GAVE_UP)))
            study.tell(trial, float(np.mean(known)))
            say(f"trial {number}: {words}: {np.mean(known):.4g}")


def _conclude(request: Request, study: Study) -> int:
    """Prints the best trial, and the command that repeats it."""
    if not study.get_trials(states=(TrialState.COMPLETE,)):
        say(f"no trial had a {request.goal}")
        return 1
    best = study.best_trial
    say(f"best {request.goal}: {best.value:.4g}, trial {best.user_attrs[NUMBER]}")
    if request.rows:
        chosen = [*request.set, *(f"{key}={value!r}" for key, value in best.params.items())]
        rows = ",".join(map(str, request.rows))
        say(f"  {_command(['snakesim', 'evaluate', request.scenario, '--rows', rows], chosen)}")
        return 0
    results = best.user_attrs[RESULTS]
    if len(results) > 1:
        say(f"  the mean of {len(results)} runs; the first of them, {results[0]:.4g}, again:")
    if best.user_attrs[STUCK]:
        say("  the search ended this run when it was stuck; this command runs it to its end, so its number may differ:")
    table = compose(request.scenario, list(map(parse_set, request.set)))
    seeds = seeds_of(table)
    found = {**best.params, **dict.fromkeys(seeds, request.seed)}
    chosen = [*request.set, *(f"{key}={value!r}" for key, value in found.items())]
    words = ["snakesim", "run", request.scenario, "--clock-mode", "lockstep"]
    words += ["--until-goal"] if table.values.get("mission", {}).get("goal") else []  # without one it would be refused
    say(f"  {_command(words, chosen)}")
    return 0


def _command(words: Sequence[str], chosen: Sequence[str]) -> str:
    return shlex.join([*words, *(word for one in chosen for word in ("--set", one))])


def _cases(request: Request, params: dict[str, Any]) -> list[Case]:
    always = {one.key: one.value for one in map(parse_set, request.set)}
    suite = read_suite(request.scenario)[0] if request.rows else Suite(scenario=request.scenario)
    cases = cases_of(also_set(suite, {**always, **params}), "optimize", [], request.seeds, request.seed)
    return rows_of(cases, request.rows, request.scenario)


def _span(text: str) -> tuple[str, Span]:
    """key=low:high; whole numbers where both are."""
    key, _, given = (part.strip() for part in text.partition("="))
    try:
        low, high = given.split(":")
        whole = low.strip("-").isdecimal() and high.strip("-").isdecimal()
        return key, IntDistribution(int(low), int(high)) if whole else FloatDistribution(float(low), float(high))
    except ValueError:
        raise ConfigError(f"--vary {short(text)}: give key=low:high, such as control.propulsion_n=5:40") from None
