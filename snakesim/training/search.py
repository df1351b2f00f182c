"""Searches a policy by CMA-ES over the parameters of a form, with seeds that are new in each generation."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cmaes
import numpy as np

from snakesim.training.episodes import EpisodeResult, EpisodeRunner
from snakesim.training.form import FORMS
from snakesim.training.kept_search import KeptGeneration, SearchCheck

CHECK_INTERVAL = 5  # generations
# First seed of the search; evaluations use seeds from 1 on.
FIRST_TRAINING_SEED = 1_000_001
FIRST_CHECK_SEED = 2_000_001  # first seed of the checks
# Step to other seeds when no scene of a generation has room for its obstacles.
RETRY_SEED_STEP = 10_000_000


@dataclass(frozen=True)
class SearchGeneration:
    """A row of the learning curve."""

    generation: int
    episodes: int  # so far, checks not counted
    mean_reward: float  # of the population, with the seeds of this generation
    best_reward: float
    # Of the mean policy, with seeds that the search does not use; None: not checked.
    check_reward: float | None
    check_advance_m: float | None
    check_goals: float | None  # share that reached it


@dataclass(frozen=True)
class SearchEffort:
    """How long to search."""

    generations: int
    population: int
    seeds: int  # number of seeds for each policy and generation
    check_seeds: int  # number of seeds for each check
    seed: int
    spread: float = 1.0  # of the first generation, times that of the form


@dataclass(frozen=True)
class SearchStep:
    """The search after one generation."""

    row: SearchGeneration
    kept: KeptGeneration  # what the search needs to go on after it
    best: dict[str, float]  # the best policy of all that were checked
    best_reward: float  # of that policy, with the check seeds


def run_search(
    episodes: EpisodeRunner,
    form: str,
    effort: SearchEffort,
    start_values: Mapping[str, float],
    known_generations: Sequence[KeptGeneration] = (),
) -> Iterator[SearchStep]:
    """Search for a policy by CMA-ES, and yield the state of the search after each generation.

    Args:
        episodes: Runs the episodes of policies.
        form: Name of the form in FORMS whose parameters are searched.
        effort: Numbers of generations, policies and seeds, and the seed of the search.
        start_values: Start values of parameters, by name. Missing parameters start at the values of the form.
        known_generations: Results of the first generations, from an earlier search with the same arguments. Their
            policies are proposed again by the optimizer, but not run.
    """
    parameters = FORMS[form]
    start = np.array(
        [start_values.get(name, parameter.start) for name, parameter in parameters.items()]
    )
    sigmas = effort.spread * np.array([parameter.sigma for parameter in parameters.values()])
    optimizer = cmaes.CMA(
        np.zeros(len(start)), 1.0, seed=effort.seed, population_size=effort.population
    )
    best_policy: dict[str, float] = {}
    best_reward = -np.inf

    def make_parameters(point: np.ndarray) -> dict[str, float]:
        """Return the parameters, by name, for a point of the search space, whose unit is one sigma."""
        return dict(zip(parameters, (start + sigmas * point).tolist(), strict=True))

    for number in range(
        effort.generations + 1
    ):  # in the last round, the mean policy is only checked
        is_last = number == effort.generations
        mean_policy = make_parameters(optimizer.mean)
        points = [] if is_last else [optimizer.ask() for _ in range(effort.population)]
        if number < len(known_generations):
            result = known_generations[number]
        else:
            is_checked = is_last or number % CHECK_INTERVAL == 0
            policies = [make_parameters(point) for point in points]
            result = KeptGeneration(
                check=_run_check(episodes, mean_policy, effort) if is_checked else None,
                rewards=_run_generation(episodes, policies, number, effort),
            )
        if result.check is not None and result.check.reward > best_reward:
            best_policy = mean_policy
            best_reward = result.check.reward
        if not is_last:
            losses = [-reward for reward in result.rewards]
            optimizer.tell(list(zip(points, losses, strict=True)))
        yield SearchStep(_make_curve_row(number, result, effort), result, best_policy, best_reward)


def _run_check(
    episodes: EpisodeRunner, policy: Mapping[str, float], effort: SearchEffort
) -> SearchCheck:
    """Run a policy with the check seeds, which the search does not use, and return the means over these episodes."""
    seeds = range(FIRST_CHECK_SEED, FIRST_CHECK_SEED + effort.check_seeds)
    check_episodes = episodes.run([policy], seeds)[0]
    return SearchCheck(
        reward=compute_mean(check_episodes, "total_reward"),
        advance_m=compute_mean(check_episodes, "advance_m"),
        goals=compute_mean(check_episodes, "goal"),
    )


def _run_generation(
    episodes: EpisodeRunner,
    policies: Sequence[Mapping[str, float]],
    number: int,
    effort: SearchEffort,
) -> list[float]:
    """Run the policies of a generation with the seeds of the generation, and return the mean reward of each policy."""
    if not policies:
        return []
    first_seed = FIRST_TRAINING_SEED + number * effort.seeds
    episodes_by_policy = episodes.run(policies, range(first_seed, first_seed + effort.seeds))
    while not all(episodes_by_policy):  # no scene of these has room for its obstacles
        first_seed += RETRY_SEED_STEP
        episodes_by_policy = episodes.run(policies, range(first_seed, first_seed + effort.seeds))
    return [compute_mean(policy_episodes, "total_reward") for policy_episodes in episodes_by_policy]


def _make_curve_row(number: int, result: KeptGeneration, effort: SearchEffort) -> SearchGeneration:
    """Return the row of the learning curve for a generation. Its rewards are NaN if no policies were run."""
    rewards = result.rewards or [np.nan]
    check = result.check
    return SearchGeneration(
        generation=number,
        episodes=min(number + 1, effort.generations) * effort.population * effort.seeds,
        mean_reward=float(np.mean(rewards)),
        best_reward=float(np.max(rewards)),
        check_reward=None if check is None else check.reward,
        check_advance_m=None if check is None else check.advance_m,
        check_goals=None if check is None else check.goals,
    )


def compute_mean(episodes: Sequence[EpisodeResult], name: str) -> float:
    """Return the mean of an attribute over episodes."""
    return float(np.mean([getattr(episode, name) for episode in episodes]))
