"""Searches a policy by CMA-ES over the parameters of a form, on fields that are new in each generation."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cmaes
import numpy as np

from snakesim.training.episodes import Episode, Episodes
from snakesim.training.form import FORMS
from snakesim.training.kept_search import Check, KeptGeneration

CHECK_EVERY = 5  # generations
FIRST_FIELD = 1_000_001  # seed of the first field that is searched on; evaluations use fields from 1 on
CHECK_FIELD = 2_000_001  # seed of the first field that policies are checked on
OTHER_FIELDS = 10_000_000  # step to other seeds when no field of a generation has room for its obstacles


@dataclass(frozen=True)
class Generation:
    """A row of the learning curve."""

    generation: int
    episodes: int  # so far, checks not counted
    mean_reward: float  # of the population, on this generation's fields
    best_reward: float
    check_reward: float | None  # of the distribution's mean, on fields that it is not searched on; None: not checked
    check_advance_m: float | None
    check_goals: float | None  # share that reached it


@dataclass(frozen=True)
class Effort:
    """How long to search."""

    generations: int
    population: int
    fields: int  # for each policy
    check_fields: int
    seed: int
    spread: float = 1.0  # of the first generation, times that of the form


@dataclass(frozen=True)
class Step:
    """The search after one generation."""

    row: Generation
    kept: KeptGeneration  # what the search needs to go on after it
    best: dict[str, float]  # the best policy of all that were checked
    best_reward: float  # of that policy, on the fields that it was checked on


def search(
    episodes: Episodes,
    form: str,
    effort: Effort,
    begin: Mapping[str, float],
    kept: Sequence[KeptGeneration] = (),
) -> Iterator[Step]:
    """Search, and yield each generation as it is done.

    Args:
        episodes: runs policies.
        form: name of the form whose parameters are searched.
        effort: how long to search.
        begin: parameters where the search begins, if not where the form does.
        kept: the first generations, as an earlier search with the same arguments has run them. Their policies are
            asked for again, but not run.
    """
    parameters = FORMS[form]
    starts = np.array([begin.get(name, parameter.start) for name, parameter in parameters.items()])
    sigmas = effort.spread * np.array([parameter.sigma for parameter in parameters.values()])
    optimizer = cmaes.CMA(np.zeros(len(starts)), 1.0, seed=effort.seed, population_size=effort.population)
    best: dict[str, float] = {}
    best_reward = -np.inf

    def name_values(point: np.ndarray) -> dict[str, float]:
        """Return the parameters for a point of the search, which has one sigma as its unit."""
        return dict(zip(parameters, (starts + sigmas * point).tolist(), strict=True))

    for number in range(effort.generations + 1):
        is_last = number == effort.generations
        mean = name_values(optimizer.mean)
        points = [] if is_last else [optimizer.ask() for _ in range(effort.population)]
        if number < len(kept):
            done = kept[number]
        else:
            is_checked = is_last or number % CHECK_EVERY == 0
            policies = [name_values(point) for point in points]
            done = KeptGeneration(
                check=_check(episodes, mean, effort) if is_checked else None,
                rewards=_run_generation(episodes, policies, number, effort),
            )
        if done.check is not None and done.check.reward > best_reward:
            best = mean
            best_reward = done.check.reward
        if not is_last:
            losses = [-reward for reward in done.rewards]
            optimizer.tell(list(zip(points, losses, strict=True)))
        yield Step(_row(number, done, effort), done, best, best_reward)


def _check(episodes: Episodes, policy: Mapping[str, float], effort: Effort) -> Check:
    """Run a policy on the fields that nothing is searched on."""
    fields = range(CHECK_FIELD, CHECK_FIELD + effort.check_fields)
    ran = episodes.run([policy], fields)[0]
    return Check(mean_of(ran, "total_reward"), mean_of(ran, "advance_m"), mean_of(ran, "goal"))


def _run_generation(
    episodes: Episodes, policies: Sequence[Mapping[str, float]], number: int, effort: Effort
) -> list[float]:
    """Run the policies of a generation on its fields; return the mean reward of each."""
    if not policies:
        return []
    first = FIRST_FIELD + number * effort.fields
    ran = episodes.run(policies, range(first, first + effort.fields))
    while not all(ran):  # no field of these has room for its obstacles
        first += OTHER_FIELDS
        ran = episodes.run(policies, range(first, first + effort.fields))
    return [mean_of(of_policy, "total_reward") for of_policy in ran]


def _row(number: int, done: KeptGeneration, effort: Effort) -> Generation:
    """Return the row of the learning curve for a generation."""
    rewards = done.rewards or [np.nan]
    check = done.check
    return Generation(
        generation=number,
        episodes=min(number + 1, effort.generations) * effort.population * effort.fields,
        mean_reward=float(np.mean(rewards)),
        best_reward=float(np.max(rewards)),
        check_reward=None if check is None else check.reward,
        check_advance_m=None if check is None else check.advance_m,
        check_goals=None if check is None else check.goals,
    )


def mean_of(ran: Sequence[Episode], name: str) -> float:
    """Return the mean of an attribute over episodes."""
    return float(np.mean([getattr(episode, name) for episode in ran]))
