"""The search for a policy: CMA-ES over the parameters of a form, on fields that are drawn anew each generation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cmaes
import numpy as np

from snakesim.training.episodes import Episode, Episodes
from snakesim.training.form import FORMS

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


def search(
    episodes: Episodes,
    form: str,
    effort: Effort,
    begin: Mapping[str, float],
    tell: Callable[[Generation, dict[str, float]], None],
) -> tuple[dict[str, float], float]:
    """The best of all checked policies, and its mean reward there.

    begin: parameters where it begins, if not where the form does. tell: gets each generation as it is done, and the
    best until then.
    """
    parameters = FORMS[form]
    starts = np.array([begin.get(name, one.start) for name, one in parameters.items()])
    sigmas = effort.spread * np.array([one.sigma for one in parameters.values()])
    optimizer = cmaes.CMA(np.zeros(len(starts)), 1.0, seed=effort.seed, population_size=effort.population)
    best: tuple[float, dict[str, float]] = (-np.inf, {})

    def values(asked: np.ndarray) -> dict[str, float]:
        return dict(zip(parameters, (starts + sigmas * asked).tolist(), strict=True))

    checked_on = range(CHECK_FIELD, CHECK_FIELD + effort.check_fields)
    for number in range(effort.generations + 1):
        check: Sequence[Episode] = ()
        if number % CHECK_EVERY == 0 or number == effort.generations:
            mean = values(optimizer.mean)
            check = episodes.run([mean], checked_on)[0]
            best = max(best, (mean_of(check, "paid"), mean), key=lambda one: one[0])
        paid = [np.nan]
        if number < effort.generations:
            first = FIRST_FIELD + number * effort.fields
            asked = [optimizer.ask() for _ in range(effort.population)]
            tried = [values(one) for one in asked]
            while not all(ran := episodes.run(tried, range(first, first + effort.fields))):
                first += OTHER_FIELDS  # none of these has room for its obstacles
            paid = [mean_of(one, "paid") for one in ran]
            optimizer.tell([(one, -reward) for one, reward in zip(asked, paid, strict=True)])
        told = [mean_of(check, what) if check else None for what in ("paid", "advance_m", "goal")]
        done = min(number + 1, effort.generations) * effort.population * effort.fields
        tell(Generation(number, done, float(np.mean(paid)), float(np.max(paid)), *told), best[1])
    return best[1], best[0]


def mean_of(ran: Sequence[Episode], what: str) -> float:
    """Mean of a number of episodes."""
    return float(np.mean([getattr(episode, what) for episode in ran]))
