"""The search for a policy: CMA-ES over the parameters of a form, on fields that are drawn anew each generation."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cmaes
import numpy as np

from snakesim.training.episodes import Episode, Episodes
from snakesim.training.form import FORMS
from snakesim.training.kept_search import Check, KeptGeneration

CHECK_EVERY = 5  # generations
FIRST_FIELD, CHECK_FIELD, OTHER_FIELDS = 1_000_001, 2_000_001, 10_000_000  # nothing is learned on fields from 1 on


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
    starts = np.array([begin.get(name, one.start) for name, one in parameters.items()])
    sigmas = effort.spread * np.array([one.sigma for one in parameters.values()])
    optimizer = cmaes.CMA(np.zeros(len(starts)), 1.0, seed=effort.seed, population_size=effort.population)
    best: dict[str, float] = {}
    best_reward = -np.inf

    def values(asked: np.ndarray) -> dict[str, float]:
        return dict(zip(parameters, (starts + sigmas * asked).tolist(), strict=True))

    for number in range(effort.generations + 1):
        is_last = number == effort.generations
        mean = values(optimizer.mean)
        asked = [] if is_last else [optimizer.ask() for _ in range(effort.population)]
        if number < len(kept):
            done = kept[number]
        else:
            done = KeptGeneration(
                check=_check(episodes, mean, effort) if is_last or number % CHECK_EVERY == 0 else None,
                rewards=_rewards(episodes, [values(one) for one in asked], number, effort),
            )
        if done.check is not None and done.check.reward > best_reward:
            best = mean
            best_reward = done.check.reward
        if not is_last:
            optimizer.tell([(one, -reward) for one, reward in zip(asked, done.rewards, strict=True)])
        yield Step(_row(number, done, effort), done, best, best_reward)


def _check(episodes: Episodes, policy: Mapping[str, float], effort: Effort) -> Check:
    """Run a policy on the fields that nothing is searched on."""
    fields = range(CHECK_FIELD, CHECK_FIELD + effort.check_fields)
    ran = episodes.run([policy], fields)[0]
    return Check(mean_of(ran, "paid"), mean_of(ran, "advance_m"), mean_of(ran, "goal"))


def _rewards(episodes: Episodes, policies: Sequence[Mapping[str, float]], number: int, effort: Effort) -> list[float]:
    """Run the policies of a generation on its fields; return the mean reward of each."""
    if not policies:
        return []
    first = FIRST_FIELD + number * effort.fields
    while not all(ran := episodes.run(policies, range(first, first + effort.fields))):
        first += OTHER_FIELDS  # none of these has room for its obstacles
    return [mean_of(one, "paid") for one in ran]


def _row(number: int, done: KeptGeneration, effort: Effort) -> Generation:
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


def mean_of(ran: Sequence[Episode], what: str) -> float:
    """Mean of a number of episodes."""
    return float(np.mean([getattr(episode, what) for episode in ran]))
